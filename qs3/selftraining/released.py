"""The rounds of self-training as QS3's released code has them (`selftraining=qbst_released`).

It is another method than the paper's text. By lines of train_QBST_sim2real.py in
Gorilla-Lab-SCUT/QS3 (commit 22ee7e8); what is set in conf/selftraining/qbst_released.yaml, and what
is done here:

    of a class the least confident of the confident are kept (284)             order=ascending
    L_k counts the confident ones alone (265-279)                              counts=confident
    one student and one optimiser for all rounds (118, 138, 406-416)           init=persistent
    the cosine of 10 epochs is never begun anew (140, 354)                     `Phases.unbroken`
    pseudo-labels come from four fifths of the target's clouds (182-183)       `ReleasedRounds`
    a fifth of the selected ones is held out (312-315, 411-415)                `ReleasedRounds`
    the student becomes the teacher, and the result, only where it agrees
    with more of the held-out labels than ever before (405, 417-422)           `ReleasedRounds`

Left out: theta = 0.98 where the accuracy on the target's test set is above 0.9 (398-404), which
reads test labels; p >= theta for p > theta (265); a jitter drawn once a selection (249-260); the
last batch of less than 32 clouds (182, 412); and the end of an epoch with the source's last batch
(338-349), which comes later than the last of the pseudo-labels.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from qs3.datamodules.adaptation import AdaptationData
from qs3.engine.classifier import Classifier
from qs3.evaluation.metrics import predict
from qs3.runs.checkpoints import copy_weights
from qs3.selftraining.callback import SelfTraining
from qs3.selftraining.selectors import TeacherPredictions


def four_fifths(n: int) -> np.ndarray:
    """[n] bool: the first eight of each ten."""
    return np.arange(n) % 10 < 8


class ReleasedRounds(SelfTraining):
    """A pool, held-out pseudo-labels, and a teacher that only a better student replaces.

    Attributes:
        held_out: positions in the target's training clouds [h], and their pseudo-labels [h].
        best: the largest agreement with held-out pseudo-labels so far, in [0, 1].
        weights: of the student that reached it; None before the first round has ended.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.held_out: tuple[Tensor, Tensor] | None = None
        self.best = 0.0
        self.weights: dict[str, Any] | None = None

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Score the student before the next selection; the best one is the result."""
        assert isinstance(pl_module, Classifier)
        epoch = trainer.current_epoch
        phase = self.phases.phase(epoch)
        if phase > 0 and self.phases.ends(epoch):
            score = self._score(trainer, pl_module)
            if score > self.best or self.weights is None:
                self.best, self.weights = score, copy_weights(pl_module.net)
            if phase == self.phases.rounds:
                pl_module.net.load_state_dict(self.weights)
        super().on_train_epoch_end(trainer, pl_module)

    def _score(self, trainer: Trainer, pl_module: Classifier) -> float:
        data = trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(data, AdaptationData)
        assert self.held_out is not None
        index, labels = self.held_out
        clouds = data.target.at(index.numpy()).points
        found = predict(pl_module.net, clouds, data.eval_batch_size, pl_module.device)
        agreed = float((found.argmax(axis=1) == labels.numpy()).mean())
        return float(trainer.strategy.broadcast(agreed))

    def _teacher(self, pl_module: Classifier, round_: int) -> dict[str, Any] | None:
        return self.weights if round_ else super()._teacher(pl_module, round_)

    def _predictions(self, *args: Any) -> TeacherPredictions:
        """Outside of the pool with a confidence of 0, which no threshold lets through."""
        found = super()._predictions(*args)
        pool = four_fifths(len(found.ids))
        return replace(found, confidence=np.where(pool, found.confidence, 0.0))

    def _select(self, trainer: Trainer, pl_module: Classifier, round_: int) -> None:
        """As without; then the last two of each ten, class by class, are held out."""
        super()._select(trainer, pl_module, round_)
        data = trainer.datamodule  # type: ignore[attr-defined]
        index, labels = data.pseudo
        order = torch.argsort(labels, stable=True)
        kept = torch.from_numpy(four_fifths(len(order)))
        train, held = order[kept], order[~kept]
        self.held_out = (index[held], labels[held])
        data.pseudo = (index[train], labels[train])

    @property
    def state_key(self) -> str:
        """The base class's: a shared warm-up may be of either."""
        return SelfTraining.__qualname__

    def state_dict(self) -> dict[str, Any]:
        """Also the held-out labels, and the best student so far."""
        more = {"held_out": self.held_out, "best": self.best, "weights": self.weights}
        return {**super().state_dict(), **more}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        super().load_state_dict(state_dict)
        self.held_out, self.best = state_dict.get("held_out"), state_dict.get("best", 0.0)
        self.weights = state_dict.get("weights")
