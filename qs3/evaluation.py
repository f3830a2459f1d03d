"""Predictions, and what they are worth. The only place that holds the target's labels.

Nothing here is read by training: no model is chosen and no threshold set by these figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.data.datamodule import Labelled
from qs3.selftraining.table import read_pseudo_labels


@torch.no_grad()
def predict(
    net: nn.Module, points: Float[Tensor, "n p 3"], batch_size: int, device: Any = "cpu"
) -> Float[np.ndarray, "n c"]:
    """Class probabilities in eval mode, unaugmented, in the order given: nothing is random."""
    training = net.training
    net.eval()
    try:
        parts = [
            net(points[i : i + batch_size].to(device)).double().softmax(dim=1).cpu()
            for i in range(0, len(points), batch_size)
        ]
    finally:
        net.train(training)
    return torch.cat(parts).numpy()


def figures(
    predicted: Int[np.ndarray, " n"], labels: Int[np.ndarray, " n"], classes: Sequence[str]
) -> dict[str, Any]:
    """Accuracy, balanced accuracy, recalls, confusion matrix and majority rate, all plain values.

    `confusion[i][j]` counts clouds of class i predicted as j. A class without clouds has recall
    None and is left out of the balanced accuracy. `majority_rate` is what always naming the
    commonest class would reach.
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
    }


class Evaluation:
    """The target's labels (`y_target_eval`), held here and nowhere else.

    Args:
        test: the target's test clouds.
        train: its training clouds; their labels only judge pseudo-labels.
        classes: names in label order.
        batch_size: of the predictions.
    """

    def __init__(
        self, test: Labelled, train: Labelled, classes: Sequence[str], batch_size: int
    ) -> None:
        self.points, self.classes, self.batch_size = test.points, tuple(classes), batch_size
        self.y_target_eval = test.labels.numpy()
        self._train = dict(zip(train.ids, train.labels.tolist(), strict=True))

    def figures(self, net: nn.Module, device: Any = "cpu") -> dict[str, Any]:
        """What `net` is worth on the target's test clouds."""
        probabilities = predict(net, self.points, self.batch_size, device)
        return figures(probabilities.argmax(axis=1), self.y_target_eval, self.classes)

    def pseudo_labels(self, path: Path) -> dict[str, float]:
        """How right a round's pseudo-labels were: a diagnostic, computed when training is over.

        `precision`: right among the selected; `recall`: selected and right among all; `accuracy`:
        right among all.
        """
        rows = read_pseudo_labels(path)
        right = np.array([self.classes[self._train[row.id]] == row.label for row in rows])
        kept = np.array([row.selected for row in rows])
        return {
            "precision": float(right[kept].mean()),
            "recall": float((right & kept).mean()),
            "accuracy": float(right.mean()),
        }
