"""Nets for `.ci/trust_cases.py`, each with what it knows of held-out labelled clouds.

A small net of `.ci/trust_nets.py`, a classifier that comes with qs3, or the folder of a finished
run, whose source is found by its config and must be the one that it was trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from trust_domain import last_inputs
from trust_nets import MODELS, POINTS, SOURCES, labelled, parts
from trust_targets import ROOMS, Target, of_size, view

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import sample
from qs3.datamodules.splits import Labelled, labels_of, load_clouds
from qs3.datamodules.validation_split import RULES
from qs3.errors import DataError
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.evaluation.trust import Known, compared
from qs3.inference.held_out import tensors_of
from qs3.inference.model_file import values_of
from qs3.inference.model_folder import CARD, write_folder
from qs3.inference.predictor import Predictor, load
from qs3.inference.pretrained import ANY_SIZE, FOLDER, SECOND
from qs3.report.runs.data import RunFiles, read_run
from qs3.report.runs.domains import open_domain

TURNED, KNOWN, BATCH = 75, 50, 32
"""Clouds that are turned, those of each kind that a shipped net knows, and of a batch."""

SEEN_BY = {
    "dgcnn-speckle": {"M", "S_1", "S_K", *ROOMS},
    "pointnet-speckle": {"M", "S_1", "S_K", *ROOMS},
    "dgcnn-rooms": {*ROOMS},
}
"""What the classifiers that come with qs3 learnt from: their labelled clouds, and no targets."""


@dataclass(frozen=True, eq=False)
class Net:
    """A net with what it knows, and how its clouds are made.

    Attributes:
        name, source, seed: the row's; two nets differ in one of them.
        module: [B, N, 3] to logits, in eval mode.
        points, scale: of a cloud as it sees it.
        known: what it says of held-out labelled clouds.
        held_out: these clouds as stored, for another net.
        features: [v, D] what its last layer is given of them, for `trust_domain.told_apart`.
    """

    name: str
    source: str
    seed: int
    module: torch.nn.Module
    points: int
    scale: str
    known: Known
    held_out: Sequence[np.ndarray]
    features: np.ndarray


def turned(net: torch.nn.Module, points: torch.Tensor, said: np.ndarray) -> float:
    """The share of the first `TURNED` clouds that keep their class after a quarter turn."""
    index = np.unique(np.linspace(0, len(points) - 1, min(TURNED, len(points)))).astype(int)
    other = predict_rotated(net, points[index], np.pi / 2, BATCH)
    return float((other.argmax(axis=1) == said[index].argmax(axis=1)).mean())


def known_of(
    module: torch.nn.Module, points: torch.Tensor, labels: Any, measured: Any, turns: bool = True
) -> Known:
    """What the net knows of its labelled clouds."""
    said = predict(module, points, BATCH)
    kept = turned(module, points, said) if turns else None
    return Known(said, np.asarray(labels), measured, kept)


def small_net(data: Path, path: Path) -> Net:
    """One of `.ci/trust_nets.py`."""
    model, source, seed = path.stem.split("-")
    module = MODELS[model](num_classes=10).eval()
    module.load_state_dict(torch.load(path, weights_only=True))
    clouds = labelled(data, source)
    held_out, scale = parts(clouds)[1], SOURCES[source][2]
    points = held_out.clouds.all()
    known = known_of(module, points, held_out.labels, compared(clouds.clouds, 200))
    stored, features = stored_clouds(held_out), last_inputs(module, points)
    return Net(model, source, int(seed), module, POINTS, scale, known, stored, features)


def shipped_net(name: str, every: dict[str, Target]) -> Net:
    """A classifier that comes with qs3; without statistics in its folder they are made first."""
    predictor = load(name)
    result, known = predictor.result, predictor.held_out
    few = [every[one].few(KNOWN) for one in sorted(SEEN_BY[name])]
    if known is None:
        known = known_of_scans(predictor, few)
        folder, values = FOLDER / name, values_of(result)
        write_folder(
            folder, {**values, "held_out": tensors_of(known)}, (folder / CARD).read_text("utf-8")
        )
    clouds = [of_size(cloud) for one in few for cloud in one.clouds]
    features = last_inputs(predictor.net, views_of(predictor, few))
    return Net(
        name, "shipped", 0, predictor.net, result.points, result.scale, known, clouds, features
    )


def views_of(predictor: Predictor, few: list[Target]) -> torch.Tensor:
    """Targets' clouds as its net sees them."""
    scale = predictor.result.scale
    return torch.cat([view(one, predictor.points, scale).points for one in few])


def known_of_scans(predictor: Predictor, few: list[Target]) -> Known:
    """What a net knows of scans of test meshes by its sensors, `KNOWN` of each."""
    seen = [view(one, predictor.points, predictor.result.scale) for one in few]
    return known_of(
        predictor.net,
        torch.cat([one.points for one in seen]),
        np.concatenate([one.labels for one in few]),
        np.concatenate([one.measures for one in seen]),
    )


def run_name(folder: Path) -> tuple[str, str, int] | None:
    """Name, source and seed of a run's net; None of a run that is not finished.

    Such as dgcnn_1000, R_m, 0: the steps of its warm-up, and `_m` if it knows sizes and heights; a
    net that was adapted has the selector's name, too, dgcnn_1000_qbst.

    Raises:
        DataError: it has learnt from labels of the target.
    """
    run = read_run(folder)
    return None if run.metrics is None else _name(run)


def run_net(folder: Path, cache_dir: Path | None = None, turns: bool = True) -> Net:
    """The net that a run reports, on the validation clouds of its source.

    Args:
        folder: of the run.
        cache_dir: where farthest points are kept.
        turns: whether it is asked about turned clouds, too.

    Raises:
        DataError: another rule than a run's own, or labels of the target were learnt from.
        NothingToDrawError: its source is not there, or is another one than it was trained on.
    """
    run, predictor = read_run(folder), load(folder)
    name, source, seed = _name(run)
    data = open_domain(run, "source")
    if data.classes != predictor.classes:
        raise DataError(f"{folder}: its source has other classes than the net")
    about, scale = (run.config or {})["data"], predictor.result.scale
    starts = about["fps_starts"]
    clouds = load_clouds(data, "train", predictor.points, starts, cache_dir, scale=scale)
    labels = labels_of(data, "train")
    assert labels is not None
    whole = Labelled(clouds.clouds, clouds.ids, labels)
    index = RULES[about["val"]](whole.ids, labels.numpy())[1]
    held_out, measured = whole.at(index), compared(whole.clouds)
    points = held_out.clouds.all()
    known = known_of(predictor.net, points, held_out.labels, measured, turns)
    stored, features = stored_clouds(held_out), last_inputs(predictor.net, points)
    return Net(name, source, seed, predictor.net, predictor.points, scale, known, stored, features)


def stored_clouds(labelled: Labelled) -> list[np.ndarray]:
    """As they lie on disk."""
    clouds = labelled.clouds
    return [np.asarray(clouds.stored[row]) for row in clouds.rows]


class Second:
    """Another classifier, and what it says of targets, which it is asked once."""

    def __init__(self, name: str) -> None:
        self.predictor = load(name)
        self.said: dict[str, np.ndarray] = {}

    def of_target(self, target: Target) -> np.ndarray:
        """Its classes of a target's clouds."""
        if target.name not in self.said:
            self.said[target.name] = self.answers(target.clouds)
        return self.said[target.name]

    def answers(self, clouds: Sequence[np.ndarray]) -> np.ndarray:
        """Its classes of clouds."""
        stored = np.stack([of_size(cloud) for cloud in clouds])
        order = sample(stored, self.predictor.points, 1)
        points = Clouds.of(stored, order, self.predictor.result.scale).all()
        return predict(self.predictor.net, points, BATCH).argmax(axis=1)


@cache
def second(of: str) -> Second:
    """What is asked beside a net: `pointnet-speckle`, beside that `dgcnn-speckle`."""
    return Second(ANY_SIZE if of == SECOND else SECOND)


def _name(run: RunFiles) -> tuple[str, str, int]:
    about, config = run.metrics, run.config or {}
    assert about is not None
    if about.method == "supervised":
        raise DataError(f"{run.folder}: the net has learnt from labels of the target")
    words = [about.model, config["protocol"]["steps"]]
    words += [about.selftraining] * (about.selftraining != "none")
    source = config["data"]["source"]["symbol"] + "_m" * (about.loading.scale == "above_floor")
    return "_".join(str(word) for word in words if word), source, about.seed
