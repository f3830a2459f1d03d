"""`qs3 report judge`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError
from qs3.utils.cli import FLAG, NUMBER, Command, Option, path, several, text

_SUFFIXES = (".csv", ".json")


def _judge(out: Path | None, **given: Any) -> None:
    if out and out.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"out={out} must end in {' or '.join(_SUFFIXES)}")
    from qs3.report.judge import text as texts
    from qs3.report.judge.judging import judge
    from qs3.utils.files import write_text

    runs: Sequence[str] = given.pop("runs")
    keep: Path | None = given["keep"]
    verdict = judge(runs, given.pop("data"), **given)
    print(texts.text(verdict))
    if keep:
        print(f"kept in {keep}")
    if out:
        write = texts.csv_text if out.suffix.lower() == ".csv" else texts.json_text
        write_text(out, write(verdict))
        print(f"saved {out}")


JUDGE = Command(
    "qs3 report judge",
    "saved runs on an archive of real objects that nobody trained on",
    _judge,
    (
        Option(
            "runs", several(text("PATH")), "folders of runs, or of seeds, or patterns",
            required=True,
        ),
        Option("data", path("FILE"), "the archive, .npz", required=True),
        Option("classes", several(text("NAME")), "only objects of these (default: all)", ()),
        Option("part", text("NAME"), "part of the archive (default: judge, if it has one)", ""),
        Option("inliers_only", FLAG, "leave out points that the archive marks as stray", True),
        Option("floor", NUMBER, "its z in metres: minus the camera's height (default: each run's)"),
        Option("prior", text("rooms|C:N,C:N"), "also with classes as common: see qs3 predict", ""),
        Option("prior_power", NUMBER, "how much of that is believed: 0 nothing, 1 all", 0.5),
        Option("device", text("DEVICE"), "cpu, cuda or cuda:1", "cpu"),
        Option("out", path("FILE"), ".csv or .json, with all digits"),
        Option("keep", path("FOLDER"), "gets each net's answers, for runs= without its weights"),
    ),
    (
        "qs3 report judge runs=logs/qs3_s2d data=held_back.npz",
        "qs3 report judge runs=logs/source_only_s2d,logs/qs3_s2d data=held_back.npz out=judged.csv",
        "qs3 report judge runs=logs/source_only_s2d data=held_back.npz keep=answers",
        "qs3 report judge runs=dgcnn-rooms data=held_back.npz floor=-1.2 prior=rooms",
    ),
    about="""
Accuracy, balanced accuracy over the classes that are there, and the majority rate, for all objects
and for the clean and the hard ones apart; and the recall of each class. Runs of one config that saw
the same data are one row, averaged over their seeds. The other rows are compared with the first,
paired object by object and seed by seed.

Objects of one room are not independent: intervals take blocks of 30 frames in a row as clusters.
Each cloud is thinned to the points that its run was trained with. The archive's arrays are in the
reference of the data; domain=objects reads the same file.

What keep= kept (a few kilobytes a run, laid out as below log_dir) can be given to runs= on another
day or machine, beside runs trained there: of the same archive, part and settings alone. A folder
keeps one question a part: answers to another are refused, not written over.
""",
    interrupted="nothing was saved",
)  # fmt: skip
