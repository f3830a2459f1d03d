"""More about the reported net: scores without labels, and its accuracy on training clouds."""

from __future__ import annotations

import logging
import math
from typing import Any

from torch import nn

from qs3.datamodules.splits import Labelled, Unlabelled
from qs3.evaluation.metrics import predict
from qs3.evaluation.selection_rules import PSEUDO_VAL
from qs3.evaluation.validators import LABEL_FREE
from qs3.runs.metrics import TrainingAccuracy
from qs3.selftraining.student_selection import Choice

log = logging.getLogger(__name__)


def without_labels(
    net: nn.Module, target: Unlabelled, choice: Choice | None, batch_size: int, device: Any
) -> dict[str, float | None]:
    """What the net is worth by `selftraining.validators`, on the target's training clouds.

    Args:
        net: as it is reported.
        target: its training clouds; SND needs two.
        choice: how the reported student was chosen, if it was: by `pseudo_val`, its score is here.
        batch_size: of the predictions.
        device: of the net.

    Returns:
        By name; None for a score that is not a number, of a net that has diverged.
    """
    table = predict(net, target.points, batch_size, device)
    scores = {
        name: one.score(table)
        for name, one in LABEL_FREE.items()
        if name != "snd" or len(table) > 1
    }
    if choice is not None and choice.rule == PSEUDO_VAL:
        scores[PSEUDO_VAL] = choice.score
    return {name: score if math.isfinite(score) else None for name, score in scores.items()}


def training_accuracy(
    net: nn.Module, labelled: Labelled, owner: str, batch_size: int, device: Any
) -> TrainingAccuracy:
    """How many there are of the clouds that the net was trained on, and the share that is right.

    Args:
        net: as it is reported.
        labelled: those clouds.
        owner: of their labels, "source" or "target_train": whose norms the net takes for them.
        batch_size, device: of the predictions.
    """
    domain = "source" if owner == "source" else "target"
    table = predict(net, labelled.clouds.all(), batch_size, device, domain=domain)
    right = float((table.argmax(axis=1) == labelled.labels.numpy()).mean())
    log.info("%.1f %% of the %d training clouds are right", 100 * right, len(table))
    return TrainingAccuracy(n=len(table), accuracy=right)
