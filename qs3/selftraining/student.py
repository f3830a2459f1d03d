"""Keeps the student of that epoch of the last round which `selection.student` prefers.

    epoch:    ... | last round ............... |
                  ^  ^   ^   ^   ^   ^         ^
                  |  score each epoch          save the best one's weights
                  hold out a fifth (pseudo_val)

It only looks: with every rule but `pseudo_val` the run trains as with `last`, to the bit, and with
`pseudo_val` as far as the last round. Target labels cannot be reached from here.
"""

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn

from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.errors import SelectionError
from qs3.evaluation.metrics import predict
from qs3.evaluation.validators import LABEL_FREE, LAST, PSEUDO_VAL, hold_out, is_better
from qs3.kernels.norms import use_domain
from qs3.methods.base import Method, class_loss
from qs3.methods.pcm import mix, pcm_loss
from qs3.runs.checkpoints import copy_weights, save
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

STUDENT_SELECTED = "student_selected.pt"


class StudentSelection(Callback):
    """Scores each epoch of the last round; saves the best weights as `student_selected.pt`.

    It belongs behind `SelfTraining`, whose last selection it divides, and before the checkpoint.

    Attributes:
        rule: one of `validators.STUDENT_RULES`.
        scores: by epoch, of those of the last round so far; none with `last`.
        epoch, score: the best so far; None before there is one.
        held_out: positions in the target's training clouds [h], and their pseudo-labels [h].
    """

    def __init__(self, folder: Path, phases: Phases, rule: str) -> None:
        self.folder, self.phases, self.rule = folder, phases, rule
        self.scores: dict[int, float] = {}
        self.epoch: int | None = None
        self.score: float | None = None
        self.held_out: tuple[Tensor, Tensor] | None = None
        self._weights: dict[str, Any] | None = None  # only during the last round

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Hold clouds out before the last round begins; score the epochs of the last round."""
        assert isinstance(pl_module, Classifier)
        epoch, last_phase = trainer.current_epoch, self.phases.rounds
        if self.rule == LAST or last_phase == 0:
            return
        phase, ends = self.phases.phase(epoch), self.phases.ends(epoch)
        data = trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(data, AdaptationData)
        if self.rule == PSEUDO_VAL and phase == last_phase - 1 and ends:
            self._hold_out(data, trainer.world_size)
        if phase != last_phase:
            return
        # One process scores for all: batch norm's statistics differ between processes.
        mine = self._score(pl_module.net, data, pl_module) if trainer.is_global_zero else 0.0
        score = self.scores[epoch] = float(trainer.strategy.broadcast(mine))
        if is_better(self.rule, score, self.score):
            self.epoch, self.score = epoch, score
            self._weights = copy_weights(pl_module.net)
        if ends:
            if trainer.is_global_zero:
                save(self._weights, self.folder / STUDENT_SELECTED)
            self._weights = None
        trainer.strategy.barrier("epoch of the student kept")

    def _score(self, net: nn.Module, data: AdaptationData, classifier: Classifier) -> float:
        clouds, how = data.target, (data.eval_batch_size, classifier.device)
        if self.rule != PSEUDO_VAL:
            return LABEL_FREE[self.rule].score(predict(net, clouds.points, *how))
        assert self.held_out is not None
        index, labels = self.held_out
        table = predict(net, clouds.at(index.numpy()).points, *how)
        return float((table.argmax(axis=1) == labels.numpy()).mean())

    def _hold_out(self, data: AdaptationData, processes: int = 1) -> None:
        """Move a part of the last round's set aside; of the rest each process needs two."""
        assert data.pseudo is not None
        index, labels = data.pseudo
        hard, named = labels, torch.ones(len(labels), dtype=torch.bool)
        if labels.is_floating_point():  # a label of weight 0 names no class
            hard, named = labels.argmax(dim=1), labels.sum(dim=1) > 0
        round_ = self.phases.rounds - 1
        ids = [data.target.ids[i] for i in index[named].tolist()]
        held = np.zeros(len(labels), dtype=bool)
        held[named.numpy()] = hold_out(
            hard[named].numpy(), ids, derive(data.seed, PSEUDO_VAL, round_)
        )
        if not held.any() or int((~held).sum()) <= processes:
            raise SelectionError(
                f"round {round_}: too few pseudo-labels for selection.student={PSEUDO_VAL}, which "
                f"holds out a fifth of each class's; set selection.student={LAST}"
            )
        mask = torch.from_numpy(held)
        self.held_out = (index[mask], hard[mask])
        data.pseudo = (index[~mask], labels[~mask])
        log.info("round %d: %d pseudo-labelled samples held out", round_, int(held.sum()))

    def state_dict(self) -> dict[str, Any]:
        """Scores, the best epoch and its weights, the held-out clouds."""
        return {
            "scores": dict(self.scores),
            "epoch": self.epoch,
            "score": self.score,
            "held_out": self.held_out,
            "weights": self._weights,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.scores = dict(state_dict["scores"])
        self.epoch, self.score = state_dict["epoch"], state_dict["score"]
        self.held_out, self._weights = state_dict["held_out"], state_dict["weights"]

    def record(self) -> dict[str, Any]:
        """What `metrics.json` has under `student`; None for scores of a net that has diverged."""
        known = {e: score if math.isfinite(score) else None for e, score in self.scores.items()}
        return {
            "rule": self.rule,
            "epoch": self.epoch,
            "score": None if self.epoch is None else known[self.epoch],
            "scores": {str(epoch): score for epoch, score in known.items()},
            "held_out": 0 if self.held_out is None else len(self.held_out[0]),
        }


class Student(Method):
    """L = w [CE(net(x_t), ŷ_t) + m R(net(x_t))], plus w CE on labelled source clouds if any.

    ŷ_t are classes, or probabilities (CRST's LRENT).

    Args:
        pcm: mix the clouds first (QBST does not).
        weight_step: w = 1 - weight_step * (epochs of the rounds so far).
        mrkld: m, weight of R = -1/K sum_k log p_k, the divergence of the prediction from the
            uniform one up to a constant: CRST's MRKLD (Zou et al., "Confidence Regularized
            Self-Training", ICCV 2019, table 1), 0.1 in its code. At least ln K.
        first_epoch: the first epoch of the rounds.
    """

    def __init__(
        self, pcm: bool = False, weight_step: float = 0.0, mrkld: float = 0.0, first_epoch: int = 0
    ) -> None:
        super().__init__()
        self.pcm, self.weight_step, self.mrkld = pcm, weight_step, mrkld
        self.first_epoch = first_epoch

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "pseudo" and, if the batch has source clouds, "source"; each >= 0."""
        target = batch["target"]
        with use_domain(net, "target"):
            loss, logits = self._fit(net, target["points"], target["y_pseudo"], generator)
        if self.mrkld:
            loss = loss - self.mrkld * logits.log_softmax(dim=1).mean()
        terms = {"pseudo": loss}
        if "source" in batch:
            source = batch["source"]
            terms["source"], _ = self._fit(net, source["points"], source["y_source"], generator)
        if self.weight_step:
            w = 1 - self.weight_step * (batch["epoch"] - self.first_epoch)
            terms = {name: w * term for name, term in terms.items()}
        return terms

    def _fit(
        self, net: nn.Module, points: Tensor, labels: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy, mixed or not, and logits."""
        if not self.pcm:
            logits = net(points)
            return class_loss(logits, labels, self.smoothing), logits
        mixed, labels_a, labels_b, lam = mix(points, labels, generator)
        logits = net(mixed)
        return pcm_loss(logits, labels_a, labels_b, lam, self.smoothing), logits
