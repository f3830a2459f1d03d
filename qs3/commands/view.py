"""`qs3 view`: clouds of files, datasets and runs on a page where they can be turned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval


def view(
    path: Annotated[str, "what to show"],
    *paths: Annotated[str, "more of them"],
    out: Annotated[Path, "the page"] = Path("view.html"),
    clouds: Annotated[int, Interval(ge=1, le=500), "at most so many"] = 50,
    points: Annotated[int | None, Interval(ge=1, le=200_000), "of each cloud"] = None,
    colour: Annotated[
        Literal["", "height", "view", "residual", "class", "confidence"], "shown first"
    ] = "",
    match: Annotated[str, "only clouds with this in their names"] = "",
    up: Annotated[Literal["x", "y", "z", "-x", "-y", "-z"], "of files: what points up"] = "z",
    variant: Annotated[str, "of a dataset, such as points_clean"] = "",
    data_dir: Annotated[Path | None, "of runs and domains: where their data are"] = None,
) -> int:
    """Clouds on a page where they can be turned.

    A path is a file of clouds in any format of `qs3 predict`, a mesh, an archive of objects, a
    folder of files, the folder of a dataset or the name of a domain, or the folder of a finished
    run: its most confident errors come first. Of more clouds than clouds=, and of more points than
    points=, some are drawn at random, always the same ones. Meshes are shown by samples of their
    surface.

    The page is one file that needs neither a network nor qs3. Drag to turn, click to enlarge, find
    by words such as "chair" or "wrong". Colours: height; the view that saw a point; residual, the
    distance of a point to the true surface, where the dataset knows it; class; confidence.

    A damaged file is named and the others go on; the exit status is then 1.

    Examples:
        qs3 view scans
        qs3 view chair.ply other/chair.ply points=20000
        qs3 view data/specklenet10 match=chair colour=residual
        qs3 view logs/qs3_s2d/seed0-5f0c2a71 out=errors.html
    """
    from qs3.report.view import Wanted
    from qs3.report.view import view as page
    from qs3.utils.files import write_text

    wanted = Wanted(match, up, variant, data_dir, points)
    text, about, failed = page([path, *paths], clouds, colour, wanted)
    write_text(out, text)
    print(*about, *(f"not read: {words}" for words in failed), sep="\n")
    print(f"saved {out}, {len(text) / 1e6:.2f} MB; open it in a browser")
    return 1 if failed else 0
