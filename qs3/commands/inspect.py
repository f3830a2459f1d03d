"""`qs3 inspect` and `qs3 compare`: what datasets are like."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from annotated_types import Ge

_OUT = Path("out/inspection")
_TURNABLE = 50  # clouds on the page where they can be turned


def inspect(
    domain: Annotated[str, "of conf/domain, or a dataset's folder"],
    *,
    data_dir: Annotated[str | None, "where datasets lie, paths.data_dir of a run"] = None,
    sample: Annotated[int, Ge(1), "clouds measured one by one; of more, some are drawn"] = 3000,
    seed: Annotated[int, Ge(0), "of all random draws"] = 0,
    out: Annotated[Path | None, "where text and pictures go (out/inspection/NAME)"] = None,
    **overrides: Annotated[str, "of the domain's config, e.g. published.folder=PATH"],
) -> None:
    """What a dataset is like, before training on it.

    What it is made of, counts by class and split, sizes, spacing, density, coverage, copies, leaks
    from train to test, odd objects; a contact sheet of all classes and a page where clouds can be
    turned. Published files are imported first.

    Examples:
        qs3 inspect modelnet10
        qs3 inspect domain=own published.folder=scans
        qs3 inspect data/specklenet10 variant=points_clean
    """
    from qs3.report.datasets import chosen, open_named, part_of
    from qs3.report.inspection import domain_text, measured
    from qs3.report.sheets import class_sheet
    from qs3.report.viewer import page
    from qs3.utils.files import make_folder, write_text
    from qs3.utils.pictures import save_png

    opened = open_named(domain, _with(data_dir, overrides))
    data, split = opened.data, next(iter(opened.data.counts()))
    clouds = measured(opened, sample, seed)
    text, heading = domain_text(opened, clouds), f"{opened.label}, {split}"
    folder = make_folder(out or _OUT / _name(opened.name, opened.variant))
    write_text(folder / "inspection.csv", clouds.to_csv(index=False))
    write_text(folder / "inspection.txt", text + "\n")
    save_png(class_sheet(data, split, heading), folder / "clouds.png", colours=256)
    part = part_of(opened, chosen(data, _TURNABLE), False)
    write_text(folder / "clouds.html", page(opened.label, [part]))
    print(f"{text}\n\nsaved text, table, pictures and clouds.html in {folder}")


def compare(
    a: Annotated[str, "of conf/domain, or a dataset's folder"],
    b: Annotated[str, "another one"],
    *,
    data_dir: Annotated[str | None, "where datasets lie, paths.data_dir of a run"] = None,
    seed: Annotated[int, Ge(0), "of all random draws"] = 0,
    out: Annotated[Path | None, "where text and picture go (out/inspection/A-B)"] = None,
    **overrides: Annotated[str, "of both domains' configs; a.KEY and b.KEY of one"],
) -> None:
    """Two datasets and the gap between them.

    What they are made of, class frequencies, spacing, density, coverage, distance to the true
    surface and how much of it was measured (of generated datasets), how well clouds tell their
    domain; one object of each class from both, as a picture.

    Examples:
        qs3 compare modelnet10 specklenet10
        qs3 compare specklenet10 specklenet10 a.variant=points_clean
        qs3 compare roomscan10 objects b.published.file=FILE b.published.fold=0
    """
    from qs3.report.datasets import open_named
    from qs3.report.inspection import compare as measure
    from qs3.report.inspection import pair_text
    from qs3.report.sheets import scan_picture
    from qs3.utils.files import make_folder, write_json, write_text
    from qs3.utils.pictures import save_png

    sides = []
    for side, name, other in (("a.", a, "b."), ("b.", b, "a.")):
        own = {k.removeprefix(side): v for k, v in overrides.items() if not k.startswith(other)}
        sides.append(open_named(name, _with(data_dir, own)))
    facts = measure(sides[0], sides[1], seed)
    text, names = pair_text(facts), [_name(one.name, one.variant) for one in sides]
    folder = make_folder(out or _OUT / "-".join(names))
    write_json(folder / "comparison.json", facts)
    write_text(folder / "comparison.md", text)
    common = [split for split in sides[0].data.counts() if split in sides[1].data.counts()]
    if common:
        both = {f"{side}: {one.label}": one.data for side, one in zip("AB", sides, strict=True)}
        save_png(scan_picture(both, common[0]), folder / "clouds.png", colours=256)
    print(f"{text}\nsaved comparison.json, comparison.md and clouds.png in {folder}")


def _with(data_dir: str | None, overrides: dict[str, str]) -> dict[str, str]:
    return ({"paths.data_dir": data_dir} if data_dir else {}) | overrides


def _name(name: str, variant: str) -> str:
    return name if variant == "points" else f"{name}_{variant}"
