"""`qs3 view`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.errors import ConfigError
from qs3.report.viewer import COLOURS, MOST_CLOUDS, MOST_POINTS
from qs3.utils.cli import FLAG, Command, Option, one_of, text, whole


def _view(words: Sequence[str], **given: Any) -> int:
    from qs3.report.view.command import Settings, view_command

    if not words:
        raise ConfigError("missing argument: qs3 view PATH (see qs3 view --help)")
    said, failed = view_command(Settings(paths=tuple(words), **given))
    print(said)
    return 1 if failed else 0


VIEW = Command(
    "qs3 view",
    "clouds on a page where they can be turned",
    _view,
    (
        Option("out", text("FILE"), "the page", "view.html"),
        Option("clouds", whole(), f"at most so many; up to {MOST_CLOUDS}", 50),
        Option(
            "points",
            whole(),
            f"of each cloud, up to {MOST_POINTS} (default: 102400 shared among them)",
        ),
        Option("colour", one_of(*COLOURS), "what is shown first (default height)", ""),
        Option("match", text("WORDS"), "only clouds with this in their names", ""),
        Option("up", text("AXIS"), "of files, what points up: x y z -x -y or -z", "z"),
        Option("variant", text("NAME"), "of a dataset, such as points_clean", ""),
        Option("residual", FLAG, "of a dataset: distances to the surface, if they are known", True),
        Option("data_dir", text("FOLDER"), "of runs and domains: where their data are"),
    ),
    (
        "qs3 view scans",
        "qs3 view chair.ply other/chair.ply points=20000",
        "qs3 view data/specklenet10 match=chair colour=residual",
        "qs3 view logs/qs3_s2d/seed0-5f0c2a71 out=errors.html",
    ),
    about="""
PATH is a file of clouds in any format of `qs3 predict`, a mesh, an archive of objects, a folder of
files, the folder of a dataset or the name of a domain, or the folder of a finished run: its most
confident errors come first. Several stand on one page. Of more clouds than clouds=, and of more
points than points=, some are drawn at random, always the same ones, and the page says so. Meshes
are shown by samples of their surface.

The page is one file that needs neither a network nor qs3. Drag to turn (all together, or each
alone), click to enlarge, find by words such as "chair" or "wrong". Colours: height; the view that
saw a point; residual, the distance of a point to the true surface, where the dataset knows it;
class; confidence.

A damaged file is named and the others go on. The exit status is then 1.
""",
    words="PATH...",
    interrupted="nothing was saved",
)
