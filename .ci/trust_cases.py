"""The cases on which `qs3.evaluation.trust` is calibrated: nets, targets, shifts and the truth.

    python .ci/trust_cases.py cases data=data nets=out/trust objects=FILE.npz out=CASES.csv jobs=2
    python .ci/trust_cases.py cases data=data runs=LOGS/EXPERIMENT objects=FILE.npz out=CASES.csv
    python .ci/trust_cases.py agree cases=FOLDER answers=out/answers

Nets are those of `.ci/trust_nets.py`, the classifiers that come with qs3 (`shipped=false` leaves
them out), and finished runs: `runs=` names their folders, or the folder of an experiment.
`.ci/trust_targets.py` has the targets. A net that the table has is not asked again. With
`answers=FOLDER` the classes that each net names, and a second classifier of the same clouds, are
kept there, of which `agree` makes agreement.csv beside cases.csv and adapted.csv. `turns=false`
asks no net about turned clouds, `targets=real` asks about real targets alone.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from trust_domain import last_inputs, told_apart
from trust_known import SEEN_BY, Net, run_name, run_net, second, shipped_net, small_net, turned
from trust_nets import POINTS
from trust_targets import Target, View, targets, view

from qs3.classes import CLASSES
from qs3.errors import DataError
from qs3.evaluation.confidences import estimates
from qs3.evaluation.metrics import predict
from qs3.evaluation.trust import Seen, shifts
from qs3.inference.predictor import load
from qs3.runs.folder import METRICS

FIRST = ("net", "source", "seed", "target", "left_out", "clouds", "held_out", "accuracy")
CONFIDENCE = ("calibrated", "thresholded_confidence", "difference")
SHIFTS = ("unsure", "thresholded", "answers", "shapes", "outside", "counts", "turns")
COLUMNS = (*FIRST, *CONFIDENCE, *SHIFTS, "domain")
AGREEMENT = ("net", "source", "seed", "target", "second", "seeds")


class Asked(NamedTuple):
    """What a process needs to make the cases of one net.

    Attributes:
        name: of a classifier that comes with qs3, of a file, or of a run's folder.
        data: folder of the stores.
        every: targets by name.
        views: of these, as far as they were made before.
        answers: folder for what is named; None keeps nothing.
        turns: whether nets are asked about turned clouds, too.
        only: `left_out` of the targets that are asked about; of all if there are none.
    """

    name: str
    data: Path
    every: dict[str, Target]
    views: dict[Any, View]
    answers: Path | None
    turns: bool
    only: tuple[str, ...]


_VIEWS: dict[Any, View] = {}  # of this process


def view_of(target: Target, net: Net) -> View:
    """A target as a net sees it, made once in a process."""
    key = (target.name, net.points, net.scale)
    if key not in _VIEWS:
        _VIEWS[key] = view(target, net.points, net.scale)
    return _VIEWS[key]


def case(net: Net, target: Target, seen_as: View) -> tuple[dict[str, Any], np.ndarray]:
    """A row of the table, and the classes that the net named; turns are asked if it knows them."""
    said = predict(net.module, seen_as.points, 32)
    answers = said.argmax(axis=1)
    turns = turned(net.module, seen_as.points, said) if net.known.turns is not None else None
    seen = Seen(said, seen_as.measures, turns)
    by_confidence = estimates(net.known.probabilities, net.known.labels, said)
    values = (
        *(net.name, net.source, net.seed, target.name, target.left_out, len(answers)),
        *(net.known.accuracy, float((answers == target.labels).mean())),
        *(by_confidence[key] for key in ("calibrated", "thresholded", "difference")),
    )
    found = shifts(net.known, seen)
    found["domain"] = told_apart(net.features, last_inputs(net.module, seen_as.points))
    return dict(zip(FIRST + CONFIDENCE, values, strict=True)) | found, answers


def wanted(name: str, scale: str, every: dict[str, Target]) -> list[Target]:
    """The targets of a net: none of its own sensors, and none whose floor it would have to know."""
    return [
        one
        for one in every.values()
        if one.name not in SEEN_BY.get(name, set())
        and (scale != "above_floor" or one.floor is not None)
    ]


def net_of(asked: Asked) -> Net:
    """With what it knows."""
    if asked.name in SEEN_BY:
        net = shipped_net(asked.name, asked.every)
        return net if asked.turns else replace(net, known=replace(net.known, turns=None))
    path = Path(asked.name)
    if not path.is_dir():
        return small_net(asked.data, path)
    if load(path).classes != CLASSES:
        raise DataError(f"{path}: the net has other classes than the targets")
    return run_net(path, asked.data / ".cache", asked.turns)


def cases_of(asked: Asked) -> list[dict[str, Any]]:
    """All rows of one net; its answers go into a file of `answers`."""
    torch.set_num_threads(1)
    _VIEWS.update(asked.views)
    net = net_of(asked)
    every = wanted(net.name, net.scale, asked.every)
    every = [one for one in every if not asked.only or one.left_out in asked.only]
    rows, named = [], {}
    for target in every:
        row, named[target.name] = case(net, target, view_of(target, net))
        rows.append(row)
    if asked.answers is not None:
        other = second(net.name)
        named |= {f"second/{target.name}": other.of_target(target) for target in every}
        named["held_out"] = net.known.probabilities.argmax(axis=1)
        named["second/held_out"] = other.answers(net.held_out)
        asked.answers.mkdir(parents=True, exist_ok=True)
        np.savez(asked.answers / f"{net.name}-{net.source}-{net.seed}.npz", **named)
    return rows


def prepared(work: tuple[Target, int, str]) -> tuple[tuple[str, int, str], View]:
    """A view with its key."""
    torch.set_num_threads(1)
    target, points, scale = work
    return (target.name, points, scale), view(target, points, scale)


def make_cases(given: dict[str, str]) -> None:
    """Make what the table lacks, in `jobs` processes; `wait`: seconds for more nets to come."""
    torch.set_num_threads(1)
    data, out = Path(given["data"]), Path(given["out"])
    answers = Path(given["answers"]) if "answers" in given else None
    turns = given.get("turns", "true") == "true"
    only = tuple(filter(None, given.get("targets", "").split(",")))
    out.parent.mkdir(parents=True, exist_ok=True)
    every = {target.name: target for target in targets(data, Path(given["objects"]))}
    until = time.monotonic() + float(given.get("wait", "0"))
    with get_context("fork").Pool(int(given.get("jobs", "1"))) as pool:
        views: dict[Any, View] = {}
        if "nets" in given:
            of_small = [(one, POINTS, "unit_ball") for one in every.values()]
            views = dict(pool.imap_unordered(prepared, of_small))
        under_way: dict[str, AsyncResult] = {}
        names = missing(given, out)
        while True:
            for name in names:
                if name not in under_way:
                    seen = views if name.endswith(".pt") else {}
                    asked = Asked(name, data, every, seen, answers, turns, only)
                    under_way[name] = pool.apply_async(cases_of, (asked,))
            for name in [name for name, result in under_way.items() if result.ready()]:
                append(out, rows := under_way.pop(name).get())
                print(f"{name}: {len(rows)} cases", flush=True)
            if not under_way and time.monotonic() > until:
                return
            time.sleep(2)
            names = missing(given, out) if time.monotonic() <= until else []


def missing(given: dict[str, str], out: Path) -> list[str]:
    """Nets without a row: files, folders of finished runs, and names of those that are shipped."""
    done = {(row["net"], row["source"], row["seed"]) for row in read(out)}
    found = []
    if "nets" in given:
        files = sorted(Path(given["nets"]).glob("[!.]*.pt"))
        found += [str(path) for path in files if tuple(path.stem.split("-")) not in done]
    if given.get("shipped", "true") == "true":
        found += [name for name in SEEN_BY if (name, "shipped", "0") not in done]
    for folder in runs_in(given.get("runs", "")):
        name = run_name(folder)
        if name and tuple(map(str, name)) not in done:
            found.append(str(folder))
    return found


def runs_in(names: str) -> list[Path]:
    """Folders of finished runs: those named, and those in a named folder."""
    found = [Path(name) for name in names.split(",") if name]
    every = [run for path in found for run in (path, *sorted(path.glob("seed*")))]
    return [run for run in every if (run / METRICS).is_file()]


def read(path: Path) -> list[dict[str, str]]:
    """The rows of the table; none if it is not there."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, rows: Iterable[dict[str, Any]], columns: Sequence[str] = COLUMNS) -> None:
    """Rows more; shares to four digits."""
    begun = path.is_file()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if not begun:
            writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})


def make_agreement(given: dict[str, str]) -> None:
    """Write how much less often than on held-out clouds others say the same as each case's net.

    Nets whose answers were not kept are left out.
    """
    answers, folder = Path(given["answers"]), Path(given["cases"])
    files: dict[tuple[str, ...], dict[str, np.ndarray]] = {}
    rows = []
    for row in read(folder / "cases.csv") + read(folder / "adapted.csv"):
        key = (row["net"], row["source"], row["seed"])
        path = answers / f"{'-'.join(key)}.npz"
        if path.is_file():
            rows.append(row)
            if key not in files:
                with np.load(path) as file:
                    files[key] = dict(file)
    (folder / "agreement.csv").unlink(missing_ok=True)
    append(folder / "agreement.csv", [_agreement(row, files) for row in rows], AGREEMENT)


def _agreement(
    row: dict[str, str], files: dict[tuple[str, ...], dict[str, np.ndarray]]
) -> dict[str, Any]:
    """Of one case; `seeds` is empty if no net of another seed was asked about its target."""
    net, source, seed = row["net"], row["source"], row["seed"]
    own, target = files[net, source, seed], row["target"]
    asked = [key for key in files if key[:2] == (net, source) and target in files[key]]
    seeds = sorted((key[2] for key in asked), key=int)
    following = seeds[(seeds.index(seed) + 1) % len(seeds)]
    other = files[net, source, following]
    found = {key: row[key] for key in AGREEMENT[:4]}
    found["second"] = agree_less(own, own, target, "second/")
    found["seeds"] = agree_less(own, other, target) if following != seed else ""
    return found


def agree_less(
    one: dict[str, np.ndarray], other: dict[str, np.ndarray], target: str, of: str = ""
) -> float:
    """Agreement on the held-out clouds less that on the target, at least 0."""
    same = [float((one[key] == other[of + key]).mean()) for key in ("held_out", target)]
    return max(0.0, same[0] - same[1])


if __name__ == "__main__":
    words = dict(word.split("=", 1) for word in sys.argv[2:])
    if sys.argv[1] == "cases":
        make_cases(words)
    elif sys.argv[1] == "agree":
        make_agreement(words)
