"""`qs3 inspect`, `qs3 compare` and `qs3 view`: what datasets are like, and what they look like."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Interval

_OUT = Path("out/inspection")
_TURNABLE = 50  # clouds on the page where they can be turned

_Data = Annotated[str | None, "where datasets lie, paths.data_dir of a run"]
_Domain = Annotated[str, "of conf/domain, or a dataset's folder"]


def inspect(
    domain: _Domain,
    *,
    data_dir: _Data = None,
    sample: Annotated[int, Ge(1), "clouds measured one by one; of more, some are drawn"] = 3000,
    out: Annotated[Path | None, "where text, table and page go (out/inspection/NAME)"] = None,
    **overrides: Annotated[str, "of the domain's config, e.g. published.folder=PATH"],
) -> None:
    """What a dataset is like, before training on it.

    What it is made of, counts by class and split, sizes, spacing, density, coverage, copies, leaks
    from train to test; a page where clouds of all classes can be turned. Published files are
    imported first.

    Example:
        qs3 inspect domain=own published.folder=scans
        qs3 inspect data/specklenet10 variant=points_clean
    """
    from qs3.report.datasets import chosen, open_named, part_of
    from qs3.report.inspection import domain_text, measured
    from qs3.report.viewer import page
    from qs3.utils.files import make_folder, write_text

    opened = open_named(domain, _with(data_dir, overrides))
    clouds = measured(opened, sample)
    text = domain_text(opened, clouds)
    folder = make_folder(out or _OUT / _name(opened.name, opened.variant))
    write_text(folder / "inspection.csv", clouds.to_csv(index=False))
    write_text(folder / "inspection.txt", text + "\n")
    part = part_of(opened, chosen(opened.data, _TURNABLE))
    write_text(folder / "clouds.html", page(opened.label, [part]))
    print(f"{text}\n\nsaved text, table and clouds.html in {folder}")


def compare(
    a: _Domain,
    b: Annotated[str, "another one"],
    *,
    data_dir: _Data = None,
    out: Annotated[Path | None, "where text and picture go (out/inspection/A-B)"] = None,
    **overrides: Annotated[str, "of both domains' configs; a.KEY and b.KEY of one"],
) -> None:
    """Two datasets and the gap between them.

    What they are made of, class frequencies, spacing, density, coverage, distance to the clean twin
    and how much of it was measured (of generated datasets); one object of each class from both, as
    a picture.

    Example:
        qs3 compare specklenet10 specklenet10 a.variant=points_clean
        qs3 compare rooms10 objects b.published.file=FILE b.published.fold=0
    """
    from qs3.report.datasets import open_named
    from qs3.report.inspection import compare as measure
    from qs3.report.inspection import pair_text, scan_picture
    from qs3.utils.files import make_folder, write_json, write_text
    from qs3.utils.pictures import save_png

    sides = []
    for side, name, other in (("a.", a, "b."), ("b.", b, "a.")):
        own = {k.removeprefix(side): v for k, v in overrides.items() if not k.startswith(other)}
        sides.append(open_named(name, _with(data_dir, own)))
    facts = measure(sides[0], sides[1])
    text, names = pair_text(facts), [_name(one.name, one.variant) for one in sides]
    folder = make_folder(out or _OUT / "-".join(names))
    write_json(folder / "comparison.json", facts)
    write_text(folder / "comparison.md", text)
    common = [split for split in sides[0].data.counts() if split in sides[1].data.counts()]
    if common:
        both = {f"{side}: {one.label}": one.data for side, one in zip("AB", sides, strict=True)}
        save_png(scan_picture(both, common[0]), folder / "clouds.png", colours=256)
    print(f"{text}\nsaved comparison.json, comparison.md and clouds.png in {folder}")


def view(
    path: Annotated[str, "what to show"],
    *paths: Annotated[str, "more of them"],
    out: Annotated[Path, "the page"] = Path("view.html"),
    clouds: Annotated[int, Interval(ge=1, le=500), "at most so many"] = 50,
    points: Annotated[int | None, Interval(ge=1, le=200_000), "of each cloud"] = None,
    match: Annotated[str, "only clouds with this in their names"] = "",
    up: Annotated[Literal["x", "y", "z", "-x", "-y", "-z"], "of files: what points up"] = "z",
    variant: Annotated[str, "of a dataset, such as points_clean"] = "",
    data_dir: Annotated[Path | None, "of runs and domains: where their data are"] = None,
) -> int:
    """Clouds on a page where they can be turned.

    A path is a file of clouds in any format of `qs3 predict`, a mesh, an archive of objects, a
    folder of files, the folder of a dataset or the name of a domain, or the folder of a finished
    run: its most confident errors come first. Of more clouds than clouds=, and of more points than
    points=, some are drawn at random, always the same ones.

    The page is one file that needs neither a network nor qs3. Drag to turn, click to enlarge, find
    by words such as "chair" or "wrong". Colours: height, class, confidence.

    A damaged file is named and the others go on; the exit status is then 1.

    Example:
        qs3 view chair.ply other/chair.ply points=20000
        qs3 view data/specklenet10 match=chair
        qs3 view logs/qs3_s2d/seed0-5f0c2a71 out=errors.html
    """
    from qs3.report.view import Wanted
    from qs3.report.view import view as page
    from qs3.utils.files import write_text

    wanted = Wanted(match, up, variant, data_dir, points)
    text, about, failed = page([path, *paths], clouds, wanted)
    write_text(out, text)
    print(*about, *(f"not read: {words}" for words in failed), sep="\n")
    print(f"saved {out}, {len(text) / 1e6:.2f} MB; open it in a browser")
    return 1 if failed else 0


def _with(data_dir: str | None, overrides: Mapping[str, str]) -> dict[str, str]:
    return {**({"paths.data_dir": data_dir} if data_dir else {}), **overrides}


def _name(name: str, variant: str) -> str:
    return name if variant == "points" else f"{name}_{variant}"
