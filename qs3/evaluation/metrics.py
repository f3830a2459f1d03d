"""Predictions, and what they are worth. The only place that holds the target's labels.

Nothing here is read by training: no model is chosen and no threshold set by these figures.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError
from qs3.kernels.norms import use_trained
from qs3.runs.metrics import PseudoLabelScores, Scores
from qs3.runs.predictions import Predictions, read_pseudo_labels

CALIBRATION_BINS = 15


def predict(
    net: nn.Module,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    device: Any = "cpu",
    *,
    domain: str = "target",
) -> Float[np.ndarray, "n c"]:
    """Class probabilities of `outputs_of`, float64."""
    (logits,) = outputs_of(net, lambda x: (net(x),), points, batch_size, device, domain=domain)
    return logits.softmax(dim=1).numpy()


def global_features(
    net: Any,
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    device: Any = "cpu",
    *,
    domain: str = "target",
) -> Float[np.ndarray, "n d"]:
    """The backbone's features of each cloud, float64, as `outputs_of`."""
    features = outputs_of(
        net, lambda x: (net.features(x).global_,), points, batch_size, device, domain=domain
    )
    return features[0].numpy()


@torch.no_grad()
def outputs_of(
    net: nn.Module,
    of_batch: Callable[[Tensor], tuple[Tensor, ...]],
    points: Float[Tensor, "n p 3"],
    batch_size: int,
    device: Any = "cpu",
    *,
    domain: str = "target",
) -> tuple[Float[Tensor, "n d"], ...]:
    """What `of_batch` makes of all clouds, by a net in eval mode, unaugmented, in the order given.

    Nothing is random. A net with norms for each domain uses those of `domain`, the clouds' own,
    where they were trained (`use_trained`). The net is given clouds of its weights' type
    (`trainer.precision=64-true`). Float64, on the CPU.
    """
    training = net.training
    kind = next((p.dtype for p in net.parameters()), points.dtype)
    net.eval()
    try:
        with use_trained(net, domain):
            parts = [
                tuple(x.double().cpu() for x in of_batch(batch.to(device, kind)))
                for batch in points.split(batch_size)
            ]
    finally:
        net.train(training)
    return tuple(torch.cat(each) for each in zip(*parts, strict=True))


def calibration_error(
    probabilities: Float[np.ndarray, "n c"],
    labels: Int[np.ndarray, " n"],
    bins: int = CALIBRATION_BINS,
) -> float:
    """Expected calibration error in [0, 1]: how far confidence is from accuracy on average.

    ECE = Σ_b n_b / n |accuracy_b - confidence_b| over bins of equal width, ((b-1)/B, b/B], of the
    largest probability (Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, eq. 3).
    """
    confidence, right = probabilities.max(axis=1), probabilities.argmax(axis=1) == labels
    place = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    gap = np.bincount(place, weights=right - confidence, minlength=bins)  # n_b (accuracy - conf.)
    return float(np.abs(gap).sum() / len(labels))


def scores(
    probabilities: Float[np.ndarray, "n c"],
    labels: Int[np.ndarray, " n"] | None,
    classes: Sequence[str],
) -> Scores:
    """Accuracy, balanced accuracy, recalls, confusion matrix, majority and calibration error.

    A class without clouds has recall None and is left out of the balanced accuracy. The majority
    rate is what always naming the commonest class would reach. Without labels there are counts of
    the predictions alone; a diverged net has no calibration error.
    """
    predicted, k = probabilities.argmax(axis=1), len(classes)
    if labels is None:
        counts = np.bincount(predicted, minlength=k).tolist()
        return Scores(n=len(predicted), predicted=dict(zip(classes, counts, strict=True)))
    confusion = np.bincount(labels * k + predicted, minlength=k * k).reshape(k, k)
    support, hits = confusion.sum(axis=1), confusion.diagonal()
    recall = [float(h / s) if s else None for h, s in zip(hits, support, strict=True)]
    finite = bool(np.isfinite(probabilities).all())
    return Scores(
        n=int(support.sum()),
        predicted=dict(zip(classes, confusion.sum(axis=0).tolist(), strict=True)),
        accuracy=float(hits.sum() / support.sum()),
        balanced_accuracy=float(np.mean([r for r in recall if r is not None])),
        majority_rate=float(support.max() / support.sum()),
        per_class_recall=dict(zip(classes, recall, strict=True)),
        confusion=confusion.tolist(),
        calibration_error=calibration_error(probabilities, labels) if finite else None,
    )


class Evaluation:
    """The target's labels (`y_target_eval`), held here and nowhere else.

    Args:
        test: the target's test clouds.
        labels: theirs [n]; None if they are not known.
        train_labels: of its training clouds by id, which only judge pseudo-labels; None likewise.
        classes: names in label order.
        meshes: of the test clouds by id; None or missing where not known.
        tiers: likewise.
    """

    def __init__(
        self,
        test: Clouds,
        labels: Int[Tensor, " n"] | None,
        train_labels: Mapping[str, int] | None,
        classes: Sequence[str],
        meshes: Mapping[str, str] | None = None,
        tiers: Mapping[str, str] | None = None,
    ) -> None:
        self.test, self.classes = test, tuple(classes)
        self.y_target_eval = None if labels is None else labels.numpy()
        self._train, self._meshes = train_labels, meshes or {}
        self._tiers = np.array([(tiers or {}).get(id_, "") for id_ in test.ids])

    @property
    def labelled(self) -> bool:
        """Whether the classes of the evaluated clouds are known."""
        return self.y_target_eval is not None

    def predictions_of(self, probabilities: Float[np.ndarray, "n c"]) -> Predictions:
        """These probabilities, with what is known of each cloud."""
        labels, ids = self.y_target_eval, self.test.ids
        return Predictions(
            self.classes,
            ids,
            tuple(self._meshes.get(id_) or id_ for id_ in ids),
            np.full(len(ids), -1) if labels is None else labels,
            probabilities,
            tuple(self._tiers.tolist()) if (self._tiers != "").any() else (),
        )

    def scores_of(self, probabilities: Float[np.ndarray, "n c"]) -> Scores:
        """What these predictions of the test clouds are worth."""
        return scores(probabilities, self.y_target_eval, self.classes)

    def scores_of_tiers(self, probabilities: Float[np.ndarray, "n c"]) -> dict[str, Scores] | None:
        """The same for the clouds of each tier; None without tiers or labels."""
        if self.y_target_eval is None:
            return None
        of = {str(tier): self._tiers == tier for tier in np.unique(self._tiers) if tier}
        return {
            tier: scores(probabilities[chosen], self.y_target_eval[chosen], self.classes)
            for tier, chosen in of.items()
        } or None

    def pseudo_labels(self, path: Path) -> PseudoLabelScores | None:
        """How right a round's pseudo-labels were: a diagnostic, computed when training is over.

        `precision`: right among the selected; `recall`: selected and right among all; `accuracy`:
        right among all. None without labels.
        """
        if self._train is None:
            return None
        rows = read_pseudo_labels(path)
        truth = rows.id.map(self._train)
        if truth.isna().any():
            raise DataError(f"{path} is damaged (it has other clouds); use force=true")
        right = np.array(self.classes)[truth.astype(int)] == rows.label
        return PseudoLabelScores(
            precision=float(right[rows.selected].mean()),
            recall=float((right & rows.selected).mean()),
            accuracy=float(right.mean()),
        )
