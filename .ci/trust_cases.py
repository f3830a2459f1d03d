"""The cases on which `qs3.evaluation.trust` is calibrated: nets, targets, shifts and the truth.

    python .ci/trust_cases.py cases data=data nets=out/trust objects=FILE.npz out=CASES.csv jobs=2
    python .ci/trust_cases.py fit cases=CASES.csv out=qs3/evaluation/trust_weights.json

Nets are those of `.ci/trust_nets.py` and the classifiers that come with qs3. Targets are scans of
test meshes, which no net has seen, as the stores `data/test_NAME` (docs/results/trust.md has the
commands), the sample of room scans that comes with qs3, and an archive of real objects, of which
only the part `adapt` is looked at. At most 150 clouds of each, at even steps. A case that the
table has is not made again.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import spearmanr
from trust_nets import MODELS, POINTS, SOURCES, labelled, parts

from qs3.classes import CLASSES
from qs3.data.importers.arrays import named_arrays
from qs3.data.importers.object_archive import read_archive
from qs3.data.store import open_pointset
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample
from qs3.evaluation.confidences import estimates
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.evaluation.trust import (
    LEAST_TRUSTED,
    Known,
    Seen,
    compared,
    fit_weights,
    left_out_estimates,
    shifts,
)
from qs3.evaluation.trust_file import SHIFTS, Calibration, write_calibration
from qs3.inference.held_out import tensors_of
from qs3.inference.model_file import values_of
from qs3.inference.model_folder import CARD, write_folder
from qs3.inference.predictor import Predictor, load
from qs3.inference.pretrained import FOLDER

MOST, TURNED, KNOWN = 150, 75, 50
"""Clouds of a target, how many of these are turned, and of each kind that a shipped net knows."""

STORES = {
    "M": "test_modelnet10",
    "S": "test_specklenet10",
    "S_1": "test_specklenet10_view",
    "S_K": "test_specklenet10_kinect",
    "S_tof": "test_specklenet10_tof",
}
ROOMS = {"R": "sample_kinect", "R_d435": "sample_d435", "R_tof": "sample_tof"}
SEEN_BY = {
    "dgcnn-speckle": {"M", "S_1", "S_K", *ROOMS},
    "pointnet-speckle": {"M", "S_1", "S_K", *ROOMS},
    "dgcnn-rooms": {*ROOMS},
}
"""What the classifiers that come with qs3 learnt from: their labelled clouds, and no targets."""

FLOOR = {"real": -1.18, "rooms": 0.0}
"""z of the floor, of targets in metres of which it is known."""

FIRST = ("net", "source", "seed", "target", "left_out", "clouds", "held_out", "accuracy")
ALONE = ("unsure", "thresholded", "answers", "shapes", "outside", "counts")
"""Shifts that take nothing but the clouds and the net's answers."""

CONFIDENCE = ("calibrated", "thresholded_confidence", "difference")
COLUMNS = (*FIRST, *CONFIDENCE, *SHIFTS)


@dataclass(frozen=True, eq=False)
class Target:
    """Clouds with their classes; `left_out` names what is never on both sides of a fit."""

    name: str
    left_out: str
    clouds: list[np.ndarray]
    labels: np.ndarray
    floor: float | None = None

    def few(self, most: int = MOST) -> Target:
        """At most so many, at even steps."""
        take = np.unique(np.linspace(0, len(self.labels) - 1, min(most, len(self.labels))))
        index = take.astype(int)
        some = [self.clouds[i] for i in index]
        return Target(self.name, self.left_out, some, self.labels[index], self.floor)


@dataclass(frozen=True, eq=False)
class Net:
    """A net with what it knows, and how its clouds are made."""

    name: str
    source: str
    seed: int
    module: torch.nn.Module
    points: int
    scale: str
    known: Known


def targets(data: Path, objects: Path) -> Iterator[Target]:
    """All of them that are there."""
    for name, store in STORES.items():
        if not (data / store / "meta.yaml").is_file():
            print(f"{data / store} is not there: left out")
            continue
        found = open_pointset(data / store, verify=False)
        yield Target(name, name, list(found.points), np.array(found.labels)).few()
    arrays = named_arrays(FOLDER / "source_sample.npz")
    labels = np.array([CLASSES.index(cls) for cls in arrays["cls"].tolist()])
    for name, ending in ROOMS.items():
        rows = [i for i, one in enumerate(arrays["name"].tolist()) if one.endswith(ending)]
        clouds = [arrays["points"][i].astype(np.float32) for i in rows]
        yield Target(name, name, clouds, labels[rows], FLOOR["rooms"]).few()
    archive = read_archive(objects)
    adapt = np.array(archive.of_part("adapt"))
    middle = np.median(archive.frame[adapt])
    for tier in ("clean", "hard"):
        for half, other_rooms in (("a", False), ("b", True)):
            wanted = (archive.tier[adapt] == tier) & (
                (archive.frame[adapt] > middle) == other_rooms
            )
            rows = adapt[wanted].tolist()
            few = Target("", "", rows, np.zeros(len(rows))).few().clouds
            clouds = [archive.cloud(i, inliers_only=True) for i in few]
            of = np.array([CLASSES.index(str(archive.cls[i])) for i in few])
            yield Target(f"real_{tier}_{half}", "real", clouds, of, FLOOR["real"])


class View(NamedTuple):
    """A target's clouds as nets see them."""

    points: torch.Tensor
    measures: np.ndarray


def view(target: Target, points: int, scale: str) -> View:
    """Farthest points of each cloud, in the given scale."""
    stored = np.stack([of_size(cloud) for cloud in target.clouds])
    clouds = Clouds.of(stored, sample(stored, points, 1), scale, target.floor or 0.0)
    return View(clouds.all(), compared(clouds))


def of_size(cloud: np.ndarray, size: int = 2048) -> np.ndarray:
    """Points repeated from the first one on, as a store has them."""
    return np.ascontiguousarray(np.resize(cloud, (max(size, len(cloud)), 3)), dtype=np.float32)[
        :size
    ]


def turned(net: torch.nn.Module, points: torch.Tensor, said: np.ndarray) -> float:
    """The share of the first `TURNED` clouds that keep their class after a quarter turn."""
    index = np.unique(np.linspace(0, len(points) - 1, min(TURNED, len(points)))).astype(int)
    other = predict_rotated(net, points[index], np.pi / 2, 32)
    return float((other.argmax(axis=1) == said[index].argmax(axis=1)).mean())


def known_of(module: torch.nn.Module, points: torch.Tensor, labels: Any, measured: Any) -> Known:
    """What the net knows of its labelled clouds."""
    said = predict(module, points, 32)
    return Known(said, np.asarray(labels), measured, turned(module, points, said))


def small_net(data: Path, path: Path) -> Net:
    """One of `.ci/trust_nets.py`."""
    model, source, seed = path.stem.split("-")
    module = MODELS[model](num_classes=10).eval()
    module.load_state_dict(torch.load(path, weights_only=True))
    clouds = labelled(data, source)
    held_out = parts(clouds)[1]
    known = known_of(module, held_out.clouds.all(), held_out.labels, compared(clouds.clouds, 200))
    return Net(model, source, int(seed), module, POINTS, SOURCES[source][2], known)


def shipped_net(name: str, every: dict[str, Target]) -> Net:
    """A classifier that comes with qs3; without statistics in its folder they are made first."""
    predictor = load(name)
    result, known = predictor.result, predictor.held_out
    if known is None:
        known = known_of_scans(predictor, [every[one] for one in sorted(SEEN_BY[name])])
        folder, values = FOLDER / name, values_of(result)
        write_folder(
            folder, {**values, "held_out": tensors_of(known)}, (folder / CARD).read_text("utf-8")
        )
    return Net(name, "shipped", 0, predictor.net, result.points, result.scale, known)


def known_of_scans(predictor: Predictor, sensors: list[Target]) -> Known:
    """What a net knows of scans of test meshes by its sensors, `KNOWN` of each."""
    few = [one.few(KNOWN) for one in sensors]
    seen = [view(one, predictor.points, predictor.result.scale) for one in few]
    return known_of(
        predictor.net,
        torch.cat([one.points for one in seen]),
        np.concatenate([one.labels for one in few]),
        np.concatenate([one.measures for one in seen]),
    )


def case(net: Net, target: Target, seen_as: View) -> dict[str, Any]:
    """A row of the table."""
    said = predict(net.module, seen_as.points, 32)
    answers = said.argmax(axis=1)
    seen = Seen(said, seen_as.measures, turned(net.module, seen_as.points, said))
    by_confidence = estimates(net.known.probabilities, net.known.labels, said)
    values = (
        *(net.name, net.source, net.seed, target.name, target.left_out, len(answers)),
        *(net.known.accuracy, float((answers == target.labels).mean())),
        *(by_confidence[key] for key in ("calibrated", "thresholded", "difference")),
        *shifts(net.known, seen).values(),
    )
    return dict(zip(COLUMNS, values, strict=True))


def wanted(name: str, scale: str, every: dict[str, Target]) -> list[Target]:
    """The targets of a net: none of its own sensors, and none whose floor it would have to know."""
    return [
        one
        for one in every.values()
        if one.name not in SEEN_BY.get(name, set())
        and (scale != "above_floor" or one.floor is not None)
    ]


def cases_of(work: tuple[str, Path, dict[str, Target], dict[Any, View]]) -> list[dict[str, Any]]:
    """All rows of one net: the name of a classifier that comes with qs3, or a file."""
    torch.set_num_threads(1)
    name, data, every, views = work
    net = shipped_net(name, every) if name in SEEN_BY else small_net(data, Path(name))
    found = []
    for target in wanted(net.name, net.scale, every):
        key = (target.name, net.points, net.scale)
        found.append(case(net, target, views.get(key) or view(target, net.points, net.scale)))
    return found


def prepared(work: tuple[Target, int, str]) -> tuple[tuple[str, int, str], View]:
    """A view with its key."""
    torch.set_num_threads(1)
    target, points, scale = work
    return (target.name, points, scale), view(target, points, scale)


def make_cases(given: dict[str, str]) -> None:
    """Make what the table lacks, in `jobs` processes; `wait`: seconds for more nets to come."""
    torch.set_num_threads(1)
    data, out = Path(given["data"]), Path(given["out"])
    out.parent.mkdir(parents=True, exist_ok=True)
    every = {target.name: target for target in targets(data, Path(given["objects"]))}
    of_small = [(one, POINTS, "unit_ball") for one in every.values()]
    until = time.monotonic() + float(given.get("wait", "0"))
    shipped, nets = given.get("shipped", "true") == "true", Path(given["nets"])
    with get_context("fork").Pool(int(given.get("jobs", "1"))) as pool:
        views: dict[Any, View] = {}
        if given.get("small", "true") == "true":
            views = dict(pool.imap_unordered(prepared, of_small))
        under_way: dict[str, AsyncResult] = {}
        while True:
            for name in missing(nets, out, shipped):
                if name not in under_way:
                    seen = {} if name in SEEN_BY else views
                    under_way[name] = pool.apply_async(cases_of, ((name, data, every, seen),))
            for name in [name for name, result in under_way.items() if result.ready()]:
                append(out, rows := under_way.pop(name).get())
                print(f"{name}: {len(rows)} cases", flush=True)
            if not under_way and time.monotonic() > until:
                return
            time.sleep(2)


def missing(nets: Path, out: Path, shipped: bool) -> list[str]:
    """Nets without a row: files, and names of classifiers that come with qs3."""
    done = {(row["net"], row["source"], row["seed"]) for row in read(out)}
    found = [str(p) for p in nets.glob("[!.]*.pt") if tuple(p.stem.split("-")) not in done]
    if shipped:
        found += [name for name in SEEN_BY if (name, "shipped", "0") not in done]
    return sorted(found)


def read(path: Path) -> list[dict[str, str]]:
    """The rows of the table; none if it is not there."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, rows: list[dict[str, Any]]) -> None:
    """Rows more; shares to four digits."""
    begun = path.is_file()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if not begun:
            writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})


def make_fit(given: dict[str, str]) -> None:
    """Fit the rules on the table, score them leave-one-target-out, and write the weights."""
    rows = read(Path(given["cases"]))
    rules = {
        "alone": ALONE,
        "turns": (*ALONE, "turns"),
    }
    targets_of = [row["left_out"] for row in rows]
    base, truth = (column(rows, key) for key in ("held_out", "accuracy"))
    lines = [["calibrated confidence (AC)", *score(column(rows, "calibrated"), truth, rows)]]
    lines.append(["ATC", *score(column(rows, "thresholded_confidence"), truth, rows)])
    lines.append(["DoC", *score(column(rows, "difference"), truth, rows)])
    for rule, names in rules.items():
        table = np.stack([column(rows, name) for name in names], axis=1)
        found = left_out_estimates(names, table, base, truth, targets_of)
        lines.append([f"rule {rule}", *score(found, truth, rows)])
        weights = fit_weights(names, table, base, truth, targets_of)
        print(rule, {name: round(value, 3) for name, value in weights.items()})
        if rule == given.get("rule", "alone"):
            kept, estimate = weights, found
    print(text_of(lines))
    off = np.abs(estimate - truth)
    by = {}
    for i, row in enumerate(rows):
        by.setdefault(row["target"], []).append(i)
    print(text_of([[name, *score(estimate[index], truth[index], [rows[i] for i in index])]
                   for name, index in by.items()]))  # fmt: skip
    if "out" in given:
        found = Calibration(
            weights={name: round(value, 4) for name, value in kept.items() if value > 0},
            cases=len(rows),
            targets=len(set(targets_of)),
            mean_error=round(float(off.mean()), 4),
            error_90=round(float(np.quantile(off, 0.9)), 4),
            most_too_high=round(float((estimate - truth).max()), 4),
        )
        write_calibration(Path(given["out"]), found)
    if "estimates" in given:
        with Path(given["estimates"]).open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["net", "source", "seed", "target", "clouds", "accuracy", "expected"])
            for row, value in zip(rows, estimate, strict=True):
                cells = [row[key] for key in ("net", "source", "seed", "target", "clouds")]
                writer.writerow([*cells, row["accuracy"], f"{value:.4f}"])


HEAD = ("", "cases", "mean error", "mean", "most too high", "refused", "right", "wrong", "rank")


def score(found: np.ndarray, truth: np.ndarray, rows: list[dict[str, str]]) -> list[str]:
    """The cells of `HEAD`: errors in points, of all cases / of those that are not refused."""
    off, kept = 100 * (found - truth), found >= LEAST_TRUSTED
    one = [f"{np.abs(x).mean():.1f}" if len(x) else "-" for x in (off, off[kept])]
    high = [f"{x.max():+.1f}" if len(x) else "-" for x in (off, off[kept])]
    rank = spearmanr(found, truth).statistic if len(found) > 2 and np.ptp(found) > 0 else np.nan
    return [
        str(len(rows)),
        " / ".join(one),
        f"{off.mean():+.1f}",
        " / ".join(high),
        str(int((~kept).sum())),
        str(int((~kept & (truth < 0.5)).sum())),
        str(int((~kept & (truth > 0.7)).sum())),
        f"{rank:.2f}",
    ]


def text_of(lines: list[list[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in ([*HEAD], ["---"] * len(HEAD), *lines))


def column(rows: list[dict[str, str]], key: str) -> np.ndarray:
    """Of the table, as numbers."""
    return np.array([float(row[key]) for row in rows])


if __name__ == "__main__":
    words = dict(word.split("=", 1) for word in sys.argv[2:])
    if sys.argv[1] == "cases":
        make_cases(words)
    elif sys.argv[1] == "fit":
        make_fit(words)
