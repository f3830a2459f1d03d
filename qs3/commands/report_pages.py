"""`qs3 report page`, `pictures` and `pipeline`: pictures of runs, datasets and an object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated


def page(
    run: Annotated[Path, "the run's folder"],
    *,
    data_dir: Annotated[Path | None, "where its datasets are, if they have moved"] = None,
    out: Annotated[Path | None, "where the files go (default: RUN/pictures)"] = None,
    packages: Annotated[tuple[str, ...], "where a net of one's own is defined; run"] = (),
) -> None:
    """Pictures and the page of one run.

    Example:
        qs3 report page run=logs/qs3_s2d/seed0-5f0c2a71 data_dir=data
    """
    from qs3.report.run_page import draw

    drawn = draw(run, out, data_dir=data_dir, packages=packages)
    for name, reason in drawn.skipped.items():
        print(f"no {name}: {reason}")
    print(*drawn.pictures.values(), drawn.page, sep="\n")


def pictures(
    *,
    domains: Annotated[tuple[str, ...], "names of conf/domain"],
    data_dir: Annotated[Path, "where the datasets lie"] = Path("data"),
    split: Annotated[str, "whose clouds"] = "train",
    out: Annotated[Path | None, "a folder, or one .png of all (default DATA_DIR/pictures)"] = None,
) -> None:
    """Contact sheets of domains: each one's clouds, and one object of each class.

    Example:
        qs3 report pictures domains=modelnet10,specklenet10,kinectsim10
    """
    from qs3.datasets.domain import compose_domain
    from qs3.report.sheets import class_sheet, scan_picture
    from qs3.utils.pictures import save_png

    found = [compose_domain(name, {"paths.data_dir": str(data_dir)}) for name in domains]
    data = {domain.name: domain.open() for domain in found}
    columns = {
        f"{one.symbol}: {one.title}{' (simulated)' * one.simulated}": data[one.name]
        for one in found
    }
    figure = scan_picture(columns, split)
    folder = out or data_dir / "pictures"
    figures = (
        {folder: figure}
        if folder.suffix == ".png"
        else {
            folder / "domains.png": figure,
            **{
                folder / f"{one.name}.png": class_sheet(
                    data[one.name], split, f"{one.label}, {split}"
                )
                for one in found
            },
        }
    )
    for path, one in figures.items():
        save_png(one, path, colours=256)
        print(path)


def pipeline(
    *,
    domain: Annotated[str, "of conf/domain"],
    object: Annotated[str | None, "its id (default: a chair)"] = None,
    mesh: Annotated[Path | None, "a mesh file to scan in place of the domain's objects"] = None,
    view: Annotated[int, "whose images are shown"] = 0,
    out: Annotated[Path, "the picture"] = Path("pipeline.png"),
    **overrides: Annotated[str, "of generate.py, such as renderer=mitsuba sensor=kinect_v1"],
) -> None:
    """One object from images to residuals, as a picture.

    Examples:
        qs3 report pipeline domain=specklenet10 renderer=mitsuba object=chair/train/chair_0000
        qs3 report pipeline domain=specklenet10 sensor=kinect_v1 mesh=chair.glb out=chair.png
    """
    from qs3.report.pipeline import pipeline_figure, scan_object
    from qs3.utils.pictures import save_png

    words = [f"domain={domain}", *(f"{key}={value}" for key, value in overrides.items())]
    save_png(pipeline_figure(scan_object(words, object, mesh), view), out, colours=256)
    print(out)
