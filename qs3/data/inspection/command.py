"""The two commands: measure, say, save."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.data.contact_sheets import class_sheet, scan_picture
from qs3.data.inspection.measure import COMPARE_STEPS, Bounds, compare, inspect
from qs3.data.inspection.open_dataset import Opened, open_named, parse
from qs3.data.inspection.text import of_domain, of_pair
from qs3.errors import ConfigError
from qs3.utils.files import make_folder, write_json, write_text
from qs3.utils.progress import progress_bar

OUT = Path("out/inspection")
_OWN = {"domain": str, "out": str, "sample": int, "seed": int, "meshes": str}


def inspect_command(argv: Sequence[str]) -> str:
    """Inspect one domain and save what was found.

    Returns:
        The text for the terminal.

    Raises:
        ConfigError: no domain, several, or a value that does not do.
    """
    names, values, (overrides,) = parse(argv, _OWN)
    names = [*names, *([str(values["domain"])] if "domain" in values else [])]
    if len(names) != 1:
        raise ConfigError(f"which domain? domain=NAME or domain=FOLDER, one of them; {_got(argv)}")
    opened = open_named(names[0], overrides)
    bounds = _bounds(values)
    steps = min(bounds.sample, len(opened.data))
    with progress_bar(f"inspecting {opened.name}", total=steps) as advance:
        facts = inspect(opened, bounds, advance)
    out = make_folder(str(values.get("out", OUT / _file_name(opened))))
    write_json(out / "inspection.json", facts)
    text = of_domain(facts)
    write_text(out / "inspection.txt", text + "\n")
    split = next(iter(opened.data.counts()))
    class_sheet(opened.data, out / "clouds.png", split=split, heading=f"{opened.label}, {split}")
    return f"{text}\n\nsaved inspection.json, inspection.txt and clouds.png in {out}"


def compare_command(argv: Sequence[str]) -> str:
    """Compare two domains and save what was found; text for the terminal."""
    names, values, overrides = parse(argv, _OWN, sides=("a", "b"))
    if len(names) != 2 or "domain" in values:
        raise ConfigError(f"compare takes two domains, names or folders: compare A B; {_got(argv)}")
    a, b = (open_named(name, of) for name, of in zip(names, overrides, strict=True))
    bounds = _bounds(values)
    with progress_bar(f"comparing {a.name} and {b.name}", total=COMPARE_STEPS) as advance:
        facts = compare(a, b, bounds, advance)
    default = OUT / f"{_file_name(a)}-{_file_name(b)}"
    out = make_folder(str(values.get("out", default)))
    write_json(out / "comparison.json", facts)
    write_text(out / "comparison.md", of_pair(facts))
    split = next((name for name in a.data.counts() if name in b.data.counts()), None)
    if split:
        both = {f"A: {a.label}": a.data, f"B: {b.label}": b.data}
        scan_picture(both, out / "clouds.png", split=split)
    text = of_pair(facts, markdown=False)
    picture = " and clouds.png" if split else ""
    return f"{text}\nsaved comparison.json, comparison.md{picture} in {out}"


def _got(argv: Sequence[str]) -> str:
    """What was given instead, and which key of it may be a typing error of domain=."""
    given = dict(word.split("=", 1) for word in argv if "=" in word and word[:7] != "domain=")
    near = difflib.get_close_matches("domain", given, n=1)
    hint = f"; did you mean domain={given[near[0]]}?" if near else ""
    return f"got {' '.join(argv) or 'nothing'}{hint}"


def _bounds(values: dict[str, Any]) -> Bounds:
    meshes = values.get("meshes")
    return Bounds(
        sample=values.get("sample", Bounds.sample),
        seed=values.get("seed", Bounds.seed),
        meshes=Path(meshes).expanduser() if meshes else None,
    )


def _file_name(opened: Opened) -> str:
    return opened.name if opened.variant == "points" else f"{opened.name}_{opened.variant}"
