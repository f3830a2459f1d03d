"""The rounds of self-training, inside one `Trainer.fit`.

    epoch:    0 ........ warmup-1 | round 0 ....... | round 1 ....... |
              warm-up             ^                 ^
                                  select            select (the student is now the teacher)

At the end of a phase's last epoch (`on_train_epoch_end`) the teacher labels the whole target
training split, and the selected part becomes the datamodule's next training set. Weights and
optimiser are reset at the start of the next epoch (`on_train_epoch_start`), not before:
checkpoints are written in between, and must hold the trained model. Whether a reset is due
follows from the epoch alone, so no flag can be lost by a resume.
"""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.engine.classifier import Classifier
from qs3.evaluation.metrics import global_features, predict
from qs3.kernels.norms import begin_target_norms
from qs3.runs.checkpoints import copy_weights, load, save
from qs3.runs.metrics import RoundRecord
from qs3.runs.predictions import pseudo_labels_path, write_pseudo_labels
from qs3.selftraining.selectors import (
    Selection,
    TeacherPredictions,
    check_selection,
    chosen_by,
)

log = logging.getLogger(__name__)

WARMUP_SELECTED = "warmup_selected.pt"
WARMUP_LAST = "warmup_last.pt"


class WarmupSelection(Callback):
    """Saves the warm-up's weights with the best validation accuracy, the earliest on ties.

    Never looks at the target. They become `warmup_selected.pt`, the last ones `warmup_last.pt`.

    Attributes:
        rule: "source_val" as above, "last", or "given": those that the warm-up began with.
        epoch: of the weights that are kept; -1: from before the first one.
    """

    def __init__(self, folder: Path, phases: Phases, rule: str) -> None:
        self.folder, self.phases, self.rule = folder, phases, rule
        self.epoch, self.accuracy = -1, -1.0
        self._weights: dict[str, Any] | None = None  # only during the warm-up

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep what was given, before a step is taken."""
        assert isinstance(pl_module, Classifier)
        if self.rule == "given" and trainer.current_epoch == 0:
            self._weights = copy_weights(pl_module.net)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Compare this epoch with the best so far."""
        assert isinstance(pl_module, Classifier)
        epoch = trainer.current_epoch
        if self.phases.phase(epoch) != 0:
            return
        accuracy = float(trainer.callback_metrics[f"{pl_module.method.labels}_val/acc"])
        if self.rule != "given" and (self.rule == "last" or accuracy > self.accuracy):
            self.epoch, self.accuracy = epoch, accuracy
            self._weights = copy_weights(pl_module.net)
        if self.phases.ends(epoch):
            if trainer.is_global_zero:
                save(self._weights, self.folder / WARMUP_SELECTED)
                save(copy_weights(pl_module.net), self.folder / WARMUP_LAST)
            self._weights = None
            trainer.strategy.barrier("warm-up saved")

    def state_dict(self) -> dict[str, Any]:
        """Best epoch so far and its weights."""
        return {"epoch": self.epoch, "accuracy": self.accuracy, "weights": self._weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.epoch, self.accuracy = state_dict["epoch"], state_dict["accuracy"]
        self._weights = state_dict["weights"]


class SelfTraining(Callback):
    """Selects pseudo-labels between phases and starts each round afresh.

    Attributes:
        records: what `metrics.json` says about each round so far.
    """

    def __init__(
        self, folder: Path, phases: Phases, scheme: SelfTrainingConfig, classes: Sequence[str]
    ) -> None:
        self.folder, self.phases, self.scheme = folder, phases, scheme
        self.classes = tuple(classes)
        self.records: list[RoundRecord] = []
        self._previous: Int[Tensor, " n"] | None = None  # [n] predicted labels of the round before

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """In the first epoch of a round: new optimiser state, and the weights to begin with."""
        assert isinstance(pl_module, Classifier)
        phase = self.phases.phase(trainer.current_epoch)
        if phase > 0 and self.phases.starts(trainer.current_epoch):
            goes_on = self.scheme.init == "persistent" and phase > 1
            pl_module.start_phase(self._first_weights(pl_module, phase), keep_moments=goes_on)
            begin_target_norms(pl_module.net)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """In the last epoch of a phase: label the target and choose the next training set."""
        assert isinstance(pl_module, Classifier)
        phase = self.phases.phase(trainer.current_epoch)
        if self.phases.ends(trainer.current_epoch) and phase < self.scheme.rounds:
            self._select(trainer, pl_module, round_=phase)

    def _first_weights(self, classifier: Classifier, phase: int) -> dict[str, Any] | None:
        """What a round begins with; None goes on with the student of the round before."""
        if self.scheme.init == "scratch" or (self.scheme.init == "persistent" and phase == 1):
            return classifier.fresh_net(phase).state_dict()
        if phase == 1:
            return load(self.folder / WARMUP_SELECTED, classifier.device)
        return None

    def _select(self, trainer: Trainer, pl_module: Classifier, round_: int) -> None:
        """Label the target, choose, keep the table, and hand the next training set to the data."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(data, AdaptationData)
        teacher = self._predictions(trainer, pl_module, data, round_)
        theta = self._theta(round_, teacher.confidence)
        selection = chosen_by(self.scheme.selector, teacher, theta, round_)
        if selection.labels is not None:  # a selector may name another class than the most probable
            teacher = teacher.relabelled(selection.labels)
        if self.scheme.rehearsal:
            kept = np.bincount(teacher.predicted, minlength=len(self.classes))
            every = np.ones(len(teacher.ids), dtype=bool)
            selection = dataclasses.replace(selection, selected=every, kept=kept)
        if trainer.is_global_zero:
            write_pseudo_labels(
                pseudo_labels_path(self.folder, round_),
                teacher.ids,
                teacher.predicted,
                teacher.confidence,
                selection.selected,
                self.classes,
            )
        missing = check_selection(selection, self.classes, round_, trainer.world_size)
        labels = torch.from_numpy(teacher.predicted)
        index = torch.from_numpy(selection.selected.nonzero()[0])
        if selection.soft is None:
            data.pseudo = (index, labels[index])
        else:
            data.pseudo = (index, torch.from_numpy(selection.soft).float()[index])
        self.records.append(self._record(round_, selection, labels, missing))
        self._previous = labels
        if trainer.is_global_zero:
            figures = (round_, theta, selection.confident.sum(), len(labels), len(index))
            log.info("round %d: theta %.3f, %d of %d samples confident, %d selected", *figures)
            if missing:
                log.warning("round %d: no pseudo-label for %s", round_, ", ".join(missing))

    def _theta(self, round_: int, confidence: Float[np.ndarray, " n"]) -> float:
        """With `share` that of round 0: of a student's own labels ever more are sure."""
        if self.scheme.share is not None and self.records:
            return self.records[0].theta
        return self.scheme.theta_of(round_, confidence)

    def _teacher(self, pl_module: Classifier, round_: int) -> dict[str, Any] | None:
        """The warm-up's selected weights (not its last); None is the student, in later rounds."""
        return load(self.folder / WARMUP_SELECTED, pl_module.device) if round_ == 0 else None

    def _predictions(
        self, trainer: Trainer, pl_module: Classifier, data: AdaptationData, round_: int
    ) -> TeacherPredictions:
        """Predict all training clouds of the target."""
        teacher = pl_module.net
        if (weights := self._teacher(pl_module, round_)) is not None:
            teacher = pl_module.fresh_net(phase=0).to(pl_module.device)
            teacher.load_state_dict(weights)
        clouds = (data.target.points, data.eval_batch_size, pl_module.device)
        # One process predicts for all: batch norm's statistics differ between processes.
        probabilities = trainer.strategy.broadcast(predict(teacher, *clouds))
        features = None
        if getattr(self.scheme.selector, "needs_features", False):
            features = trainer.strategy.broadcast(global_features(teacher, *clouds))
        return TeacherPredictions.of(probabilities, data.target.ids, features)

    def _record(
        self, round_: int, selection: Selection, labels: Int[Tensor, " n"], missing: list[str]
    ) -> RoundRecord:
        def by_class(values: np.ndarray) -> dict[str, Any]:
            return dict(zip(self.classes, values.tolist(), strict=True))

        own, before = selection.thresholds, self._previous
        return RoundRecord(
            round=round_,
            theta=selection.theta,
            confident=by_class(selection.confident),
            selected=by_class(selection.kept),
            mu=by_class(selection.mu),
            thresholds=None if own is None else by_class(own),
            total_confident=int(selection.confident.sum()),
            total_selected=int(selection.selected.sum()),
            missing_classes=missing,
            agreement=None if before is None else float((labels == before).double().mean()),
        )

    def state_dict(self) -> dict[str, Any]:
        """Records so far and the last labels; the selected set is the datamodule's state."""
        records = [dataclasses.asdict(record) for record in self.records]
        return {"records": records, "previous": self._previous}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.records = [RoundRecord(**record) for record in state_dict["records"]]
        self._previous = state_dict["previous"]
