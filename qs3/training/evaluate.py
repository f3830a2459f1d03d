"""Fourth stage: what the nets of a run are worth, from the weights that it saved."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from qs3.datamodules.splits import Labelled, Unlabelled
from qs3.evaluation.accuracy_estimates import estimate_accuracy
from qs3.evaluation.metrics import adapt_norms, predict
from qs3.evaluation.selection_rules import LAST, PSEUDO_VAL
from qs3.evaluation.tent import minimise_entropy
from qs3.evaluation.trust import Known
from qs3.evaluation.validators import LABEL_FREE
from qs3.runs.checkpoints import load
from qs3.runs.metrics import AccuracyEstimates, Scores, TrainingAccuracy
from qs3.runs.predictions import Predictions
from qs3.selftraining.callback import WARMUP_LAST, WARMUP_SELECTED
from qs3.selftraining.student_selection import Choice
from qs3.training.build import Built
from qs3.training.load import Loaded
from qs3.training.run import STUDENT, Run
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a run.

    Attributes:
        net: the reported one.
        predictions: its, for each evaluated cloud.
        choice: how its epoch was chosen; None: the last one's, or the warm-up's.
        final: its scores.
        scores: of "selected" and "last", the warm-up's epochs, and "student", the last round's.
        rotated: scores of the reported net and of "selected", averaged over rotations.
        validators: its label-free scores.
        quality: estimates of its accuracy.
        held_out: what it says of held-out labelled clouds; None of one that has diverged.
        training: its accuracy on training clouds, with `data.clouds_a_class` alone.
    """

    net: nn.Module
    predictions: Predictions
    choice: Choice | None
    final: Scores
    scores: Mapping[str, Scores]
    rotated: tuple[Scores | None, Scores | None]
    validators: dict[str, float | None]
    quality: AccuracyEstimates
    held_out: Known | None
    training: TrainingAccuracy | None


class SavedNets:
    """Nets with the weights in a run's files.

    Args:
        run: whose they are.
        loaded: the target's training clouds, for norms that adapt to them.
        built: how a net is made, and where it runs.
    """

    def __init__(self, run: Run, loaded: Loaded, built: Built) -> None:
        self.run, self.target = run, loaded.data.target
        self.classifier, self.device = built.classifier, built.classifier.device

    def __call__(self, file: Path) -> nn.Module:
        """As it is evaluated: with norms of the target if `evaluation.norms` says so."""
        net, cfg = self.as_trained(file), self.run.cfg
        if cfg.evaluation.norms != "trained":
            adapt = adapt_norms if cfg.evaluation.norms == "adabn" else minimise_entropy
            seed = derive(self.run.seed, cfg.evaluation.norms)
            adapt(net, self.target.points, cfg.protocol.batch_size, seed, self.device)
        return net

    def as_trained(self, file: Path) -> nn.Module:
        """With the norms that it was trained with."""
        net = self.classifier.fresh_net(phase=0).to(self.device)
        net.load_state_dict(load(file, self.device))
        return net


def evaluate(run: Run, loaded: Loaded, built: Built) -> Outcome:
    """Score the warm-up's and the student's weights; of the reported ones say more."""
    nets, evaluation = SavedNets(run, loaded, built), loaded.evaluation
    device = nets.device
    names = {"selected": WARMUP_SELECTED, "last": WARMUP_LAST, "student": STUDENT}
    files = {name: run.folder / file for name, file in names.items()}
    choice = None if built.student.rule == LAST else built.student.choice()
    reported = "student" if run.scheme.rounds else "selected"
    file = choice.file if choice else files[reported]
    net = nets(file)
    predictions = evaluation.predictions(net, device)
    final = evaluation.scores_of(predictions.probabilities)
    scores = {
        name: final if path == file else evaluation.scores(nets(path), device)
        for name, path in files.items()
    }
    rotated = evaluation.rotation_averaged(net, device)
    before = rotated if file == files["selected"] else None
    if before is None:
        before = evaluation.rotation_averaged(nets(files["selected"]), device)
    batch_size, data = run.cfg.data.eval_batch_size, loaded.data
    quality, held_out = _quality(run, loaded, nets, file, net)
    return Outcome(
        net=net,
        predictions=predictions,
        choice=choice,
        final=final,
        scores=scores,
        rotated=(rotated, before),
        validators=without_labels(net, data.target, choice, batch_size, device),
        quality=quality,
        held_out=held_out,
        training=(
            training_accuracy(net, data.labelled, data.owner, batch_size, device)
            if run.cfg.data.clouds_a_class is not None
            else None
        ),
    )


def _quality(
    run: Run, loaded: Loaded, nets: SavedNets, file: Path, net: nn.Module
) -> tuple[AccuracyEstimates, Known | None]:
    taught = run.folder / WARMUP_SELECTED if run.scheme.rounds else None
    unadapted = None
    if run.cfg.evaluation.norms != "trained":
        unadapted = nets.as_trained(file), nets.as_trained(taught) if taught else None
    data = loaded.data
    more: dict[str, Any] = {"batch_size": data.eval_batch_size, "device": nets.device}
    return estimate_accuracy(
        net,
        loaded.evaluation.test,
        data.validation,
        data.all_labelled,
        owner=data.owner,
        classes=loaded.evaluation.classes,
        teacher=nets(taught) if taught else None,
        unadapted=unadapted,
        upright=run.target.gravity == "z",
        **more,
    )


def without_labels(
    net: nn.Module, target: Unlabelled, choice: Choice | None, batch_size: int, device: Any
) -> dict[str, float | None]:
    """The reported net's scores by `qs3.evaluation.validators`, on the target's training clouds.

    Scores by name; None for one that is not a number, of a net that has diverged. SND needs two
    clouds. If the student was chosen by `pseudo_val`, its score is here.
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
    """How many clouds the reported net was trained on, and the share that is right.

    `owner`: of their labels, "source" or "target_train": whose norms the net takes for them.
    """
    domain = "source" if owner == "source" else "target"
    table = predict(net, labelled.clouds.all(), batch_size, device, domain=domain)
    right = float((table.argmax(axis=1) == labelled.labels.numpy()).mean())
    log.info("%.1f %% of the %d training clouds are right", 100 * right, len(table))
    return TrainingAccuracy(n=len(table), accuracy=right)
