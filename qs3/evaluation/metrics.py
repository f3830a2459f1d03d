"""Predictions, and what they are worth. The only place that holds the target's labels.

Nothing here is read by training: no model is chosen and no threshold set by these figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.datamodules.adaptation import Unlabelled
from qs3.datamodules.augment import rotate_z
from qs3.evaluation.calibration import calibration_error
from qs3.models.norms import adapt_batchnorm, norms_for, use_domain
from qs3.runs.predictions import Predictions
from qs3.runs.pseudo_labels import read_pseudo_labels


@torch.no_grad()
def predict(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    device: Any = "cpu",
    *,
    domain: str = "target",
) -> Float[np.ndarray, "n c"]:
    """Class probabilities in eval mode, unaugmented, in the order given: nothing is random.

    A net with norms for each domain uses those of `domain`, the clouds' own, if it was trained on
    that domain at all.
    """
    training = net.training
    net.eval()
    try:
        with use_domain(net, norms_for(net, domain)):
            parts = [
                net(points[i : i + batch_size].to(device)).double().softmax(dim=1).cpu()
                for i in range(0, len(points), batch_size)
            ]
    finally:
        net.train(training)
    return torch.cat(parts).numpy()


def adapt_norms(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    seed: int,
    device: Any = "cpu",
) -> None:
    """AdaBN: give the net's batch norms the statistics of the target's training clouds.

    One pass in random order (a dataset is sorted by class, and a batch should look like the
    whole), in batches of equal size as far as they can be.

    Args:
        net: changed in place; its weights stay.
        points: at least two clouds.
        batch_size: about how many at once.
        seed: of the order.
        device: of the net.
    """
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
    batches = torch.tensor_split(order, max(1, round(len(points) / batch_size)))
    with use_domain(net, norms_for(net, "target")):
        adapt_batchnorm(net, (points[index].to(device) for index in batches))


def predict_turned(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    rotations: int,
    batch_size: int,
    device: Any = "cpu",
) -> Float[np.ndarray, "n c"]:
    """Mean of the probabilities over `rotations` turns about gravity: by 0, 2π/n, 4π/n, ..."""
    total: Any = 0.0
    for i in range(rotations):
        angle = torch.full((len(points),), 2 * math.pi * i / rotations, dtype=points.dtype)
        total = total + predict(net, rotate_z(points, angle), batch_size, device)
    return total / rotations


def figures(
    predicted: Int[np.ndarray, " n"], labels: Int[np.ndarray, " n"], classes: Sequence[str]
) -> dict[str, Any]:
    """Accuracy, balanced accuracy, recalls, confusion matrix and majority rate, all plain values.

    `confusion[i][j]` counts clouds of class i predicted as j. A class without clouds has recall
    None and is left out of the balanced accuracy. `majority_rate` is what always naming the
    commonest class would reach. `predicted` counts the predictions of each class.
    """
    k = len(classes)
    confusion = np.bincount(labels * k + predicted, minlength=k * k).reshape(k, k)
    support, hits = confusion.sum(axis=1), confusion.diagonal()
    recall = [float(h / s) if s else None for h, s in zip(hits, support, strict=True)]
    return {
        "accuracy": float(hits.sum() / support.sum()),
        "balanced_accuracy": float(np.mean([r for r in recall if r is not None])),
        "per_class_recall": dict(zip(classes, recall, strict=True)),
        "confusion": confusion.tolist(),
        "majority_rate": float(support.max() / support.sum()),
        "n": int(support.sum()),
        "predicted": dict(zip(classes, confusion.sum(axis=0).tolist(), strict=True)),
    }


def figures_without_labels(
    predicted: Int[np.ndarray, " n"], classes: Sequence[str]
) -> dict[str, Any]:
    """The same keys for clouds whose labels nobody knows: the counts, and None for the rest."""
    counts = np.bincount(predicted, minlength=len(classes)).tolist()
    unknown = ("accuracy", "balanced_accuracy", "per_class_recall", "confusion", "majority_rate")
    return {
        **dict.fromkeys(unknown),
        "n": len(predicted),
        "predicted": dict(zip(classes, counts, strict=True)),
        "calibration_error": None,
    }


class Evaluation:
    """The target's labels (`y_target_eval`), held here and nowhere else.

    Args:
        test: the target's test clouds.
        labels: theirs [n]; None if nobody knows them.
        train_labels: of its training clouds by id, which only judge pseudo-labels; None likewise.
        classes: names in label order.
        batch_size: of the predictions.
        rotations: over how many turns `turned` averages; 0 leaves it out.
        meshes: of the test clouds by id; None or missing where not known.
    """

    def __init__(
        self,
        test: Unlabelled,
        labels: Int[Tensor, " n"] | None,
        train_labels: Mapping[str, int] | None,
        classes: Sequence[str],
        batch_size: int,
        rotations: int = 0,
        meshes: Mapping[str, str] | None = None,
    ) -> None:
        self.points, self.classes, self.batch_size = test.points, tuple(classes), batch_size
        self.y_target_eval = None if labels is None else labels.numpy()
        self.rotations = rotations
        self._train = train_labels
        self._ids, self._meshes = test.ids, meshes or {}

    def predictions(self, net: nn.Module, device: Any = "cpu") -> Predictions:
        """What `net` says of each cloud."""
        labels = self.y_target_eval
        return Predictions(
            self.classes,
            self._ids,
            tuple(self._meshes.get(id_) or id_ for id_ in self._ids),
            np.full(len(self._ids), -1) if labels is None else labels,
            predict(net, self.points, self.batch_size, device),
        )

    def figures(self, net: nn.Module, device: Any = "cpu") -> dict[str, Any]:
        """What `net` is worth on the target's test clouds: each as it is, in one fixed sample."""
        return self._figures(predict(net, self.points, self.batch_size, device))

    def turned(self, net: nn.Module, device: Any = "cpu") -> dict[str, Any] | None:
        """The same for probabilities averaged over turns; None if that was not asked for."""
        if not self.rotations:
            return None
        return self._figures(
            predict_turned(net, self.points, self.rotations, self.batch_size, device)
        )

    def _figures(self, probabilities: np.ndarray) -> dict[str, Any]:
        predicted, labels = probabilities.argmax(axis=1), self.y_target_eval
        if labels is None:
            return figures_without_labels(predicted, self.classes)
        confident = bool(np.isfinite(probabilities).all())  # of anything: else it has diverged
        return {
            **figures(predicted, labels, self.classes),
            "calibration_error": calibration_error(probabilities, labels) if confident else None,
        }

    def pseudo_labels(self, path: Path) -> dict[str, float] | None:
        """How right a round's pseudo-labels were: a diagnostic, computed when training is over.

        `precision`: right among the selected; `recall`: selected and right among all; `accuracy`:
        right among all. None without labels.
        """
        if self._train is None:
            return None
        rows = read_pseudo_labels(path)
        right = np.array([self.classes[self._train[row.id]] == row.label for row in rows])
        kept = np.array([row.selected for row in rows])
        return {
            "precision": float(right[kept].mean()),
            "recall": float((right & kept).mean()),
            "accuracy": float(right.mean()),
        }
