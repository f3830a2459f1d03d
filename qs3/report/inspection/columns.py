"""What a manifest says beyond what all have (`ManifestRow.more`): names, tiers, sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from qs3.store.manifest import OK, ManifestRow
from qs3.utils import text_table

_SHOWN = ("tier", "sensor", "vertical")


def columns(rows: Sequence[ManifestRow], meta: Mapping[str, Any]) -> dict[str, Any]:
    """Counts by class; empty for a dataset without such columns.

    Returns:
        "names": class -> name in the published dataset -> clouds, with the names of the import's
        table that did not occur; "counts": column -> class -> value -> clouds; "refused": class ->
        objects that gave no cloud.
    """
    kept = [row for row in rows if row.status == OK]
    if not any(row.more for row in rows):
        return {}
    names: dict[str, dict[str, int]] = {}
    for name, cls in dict(meta.get("imported", {}).get("names") or {}).items():
        names.setdefault(cls, {})[name] = 0
    for row in kept:
        if name := row.more.get("sub"):
            of = names.setdefault(row.cls, {})
            of[name] = of.get(name, 0) + 1
    counts: dict[str, dict[str, dict[str, int]]] = {}
    for column in _SHOWN:
        found: dict[str, Counter[str]] = {}
        for row in sorted(kept, key=lambda row: row.cls):  # however splits lie in the manifest
            if value := row.more.get(column):
                found.setdefault(row.cls, Counter())[value] += 1
        if found:
            counts[column] = {cls: dict(sorted(of.items())) for cls, of in found.items()}
    refused = Counter(sorted(row.cls for row in rows if row.status != OK and row.cls))
    return {"names": names, "counts": counts, "refused": dict(refused)}


def text(facts: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal; none where there is nothing to say."""
    if not facts:
        return []
    lines = ["", "names in the published dataset, by class"]
    for cls, of in facts["names"].items():
        lines.append(f"  {cls}: " + ", ".join(f"{name} {count}" for name, count in of.items()))
    for column, by_class in facts["counts"].items():
        values = sorted({value for of in by_class.values() for value in of})
        rows = [[column, *values]]
        rows += [
            [cls, *(str(of.get(value, 0)) for value in values)] for cls, of in by_class.items()
        ]
        totals = [sum(of.get(value, 0) for of in by_class.values()) for value in values]
        rows.append(["all", *map(str, totals)])
        lines += ["", *text_table.aligned(rows, numbers=True, rule=False)]
    if refused := facts["refused"]:
        counts = ", ".join(f"{cls} {count}" for cls, count in refused.items())
        lines += ["", f"objects left out, for reasons that manifest.csv gives: {counts}"]
    return lines
