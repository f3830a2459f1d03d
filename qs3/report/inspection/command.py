"""The two commands: measure, say, save."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from qs3.report.contact_sheets import class_sheet, scan_picture
from qs3.report.inspection.class_sheets import OBJECTS, class_sheets
from qs3.report.inspection.measure import COMPARE_STEPS, Bounds, compare, inspect
from qs3.report.inspection.open_dataset import Opened, open_named
from qs3.report.inspection.text import of_domain, of_pair
from qs3.report.inspection.viewed import chosen, part_of
from qs3.report.viewer.page import page
from qs3.utils.files import make_folder, write_json, write_text
from qs3.utils.progress import progress_bar

OUT = Path("out/inspection")
SHEETS = "sheets"
_TURNABLE = 50  # clouds on the page where they can be turned


def inspect_command(
    domain: str,
    overrides: Mapping[str, str],
    bounds: Bounds,
    out: str | None = None,
    sheets: int = OBJECTS,
) -> str:
    """Inspect one domain (see `open_named`), save what was found; the text for the terminal.

    `sheets` is how many clouds of each class its sheet has; 0: there are no sheets.
    """
    opened = open_named(domain, overrides)
    steps = min(bounds.sample, len(opened.data))
    with progress_bar(f"inspecting {opened.name}", total=steps) as advance:
        facts = inspect(opened, bounds, advance)
    folder = make_folder(out or OUT / _file_name(opened))
    write_json(folder / "inspection.json", facts)
    text = of_domain(facts)
    write_text(folder / "inspection.txt", text + "\n")
    split = next(iter(opened.data.counts()))
    heading = f"{opened.label}, {split}"
    class_sheet(opened.data, folder / "clouds.png", split=split, heading=heading)
    part = part_of(opened, chosen(opened.data, _TURNABLE), residuals=False)
    write_text(folder / "clouds.html", page(opened.label, [part]))
    saved = ["inspection.json", "inspection.txt", "clouds.png", "clouds.html"]
    if sheets:
        shown = class_sheets(opened, folder / SHEETS, split=split, most=sheets, seed=bounds.seed)
        saved.append(f"{SHEETS}/{shown[0].name}" + f" and {len(shown) - 1} more" * (len(shown) > 1))
    return f"{text}\n\nsaved {', '.join(saved)} in {folder}"


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
    text = of_pair(facts)
    write_text(folder / "comparison.md", text)
    split = next((name for name in a.data.counts() if name in b.data.counts()), None)
    if split:
        both = {f"A: {a.label}": a.data, f"B: {b.label}": b.data}
        scan_picture(both, folder / "clouds.png", split=split)
    picture = " and clouds.png" if split else ""
    return f"{text}\nsaved comparison.json, comparison.md{picture} in {folder}"


def _file_name(opened: Opened) -> str:
    return opened.name if opened.variant == "points" else f"{opened.name}_{opened.variant}"
