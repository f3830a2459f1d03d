"""The two commands: measure, say, save."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from qs3.data.inspection.measure import COMPARE_STEPS, Bounds, compare, inspect
from qs3.data.inspection.open_dataset import Opened, open_named
from qs3.data.inspection.text import of_domain, of_pair
from qs3.utils.files import make_folder, write_json, write_text
from qs3.utils.progress import progress_bar

OUT = Path("out/inspection")
_SHOWN = 6  # clouds a class


def inspect_command(
    domain: str, overrides: Mapping[str, str], bounds: Bounds, out: str | None = None
) -> str:
    """Inspect one domain and save what was found.

    Args:
        domain, overrides: see `open_named`.
        bounds: how much is looked at.
        out: folder of the results.

    Returns:
        The text for the terminal.
    """
    opened = open_named(domain, overrides)
    steps = min(bounds.sample, len(opened.data))
    with progress_bar(f"inspecting {opened.name}", total=steps) as advance:
        facts = inspect(opened, bounds, advance)
    folder = make_folder(out or OUT / _file_name(opened))
    write_json(folder / "inspection.json", facts)
    text = of_domain(facts)
    write_text(folder / "inspection.txt", text + "\n")
    _sheet(opened, folder / "clouds.png", bounds.seed)
    return f"{text}\n\nsaved inspection.json, inspection.txt and clouds.png in {folder}"


def compare_command(
    one: tuple[str, Mapping[str, str]],
    other: tuple[str, Mapping[str, str]],
    bounds: Bounds,
    out: str | None = None,
) -> str:
    """Compare two domains, each with its overrides, and save what was found; as above."""
    a, b = (open_named(name, overrides) for name, overrides in (one, other))
    with progress_bar(f"comparing {a.name} and {b.name}", total=COMPARE_STEPS) as advance:
        facts = compare(a, b, bounds, advance)
    folder = make_folder(out or OUT / f"{_file_name(a)}-{_file_name(b)}")
    write_json(folder / "comparison.json", facts)
    write_text(folder / "comparison.md", of_pair(facts))
    _side_by_side(a, b, folder / "clouds.png", bounds.seed)
    text = of_pair(facts, markdown=False)
    return f"{text}\nsaved comparison.json, comparison.md and clouds.png in {folder}"


def _file_name(opened: Opened) -> str:
    return opened.name if opened.variant == "points" else f"{opened.name}_{opened.variant}"


def _drawn(opened: Opened, cls: str, count: int, seed: int) -> list[np.ndarray]:
    data = opened.data
    if cls not in data.classes and cls != "unlabelled":
        return []
    label = data.classes.index(cls) if cls in data.classes else -1
    members = (
        np.flatnonzero(data.labels == label) if label >= 0 else np.flatnonzero(data.labels < 0)
    )
    chosen = np.random.default_rng([seed, 3, label + 1]).permutation(members)[:count]
    return [np.asarray(data.points[i]) for i in np.sort(chosen)]


def _sheet(opened: Opened, path: Path, seed: int) -> None:
    from qs3.data.inspection.sheets import sheet

    names = [*opened.data.classes, *(["unlabelled"] if (opened.data.labels < 0).any() else [])]
    rows = {cls: [_drawn(opened, cls, _SHOWN, seed)] for cls in names}
    sheet(path, {cls: of for cls, of in rows.items() if of[0]}, [""], opened.label)


def _side_by_side(a: Opened, b: Opened, path: Path, seed: int) -> None:
    from qs3.data.inspection.sheets import sheet

    names = dict.fromkeys([*a.data.classes, *b.data.classes])
    rows = {cls: [_drawn(o, cls, _SHOWN // 2, seed) for o in (a, b)] for cls in names}
    kept = {cls: of for cls, of in rows.items() if any(of)}
    sheet(path, kept, [a.label, b.label], "one view, each cloud scaled to its panel")
