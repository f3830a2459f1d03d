"""Fourth stage: what the nets of a run are worth, from the weights that it saved."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import nn

from qs3.datamodules.clouds import Labelled
from qs3.evaluation.expected import HeldOut, expected_accuracy, held_out
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.evaluation.norms import adapt_norms, minimise_entropy
from qs3.evaluation.ood import ood_share
from qs3.evaluation.prior import Prior
from qs3.evaluation.validators import LABEL_FREE, LAST, PSEUDO_VAL
from qs3.runs.checkpoints import load, weights_sha256
from qs3.runs.metrics import Quality, Scores, TrainingAccuracy
from qs3.runs.predictions import Predictions
from qs3.selftraining.callback import WARMUP_LAST, WARMUP_SELECTED
from qs3.selftraining.student_selection import StudentSelection
from qs3.training.build import Built
from qs3.training.load import Loaded, Shares, prior_beside, shares_of_student
from qs3.training.run import STUDENT, Run
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

TRAINED = "trained"
ADAPTERS: dict[str, Callable[..., None]] = {
    "adabn": adapt_norms,
    "alpha_bn": partial(adapt_norms, kept=0.5),  # why half: docs/results/tried.md
    "tent": minimise_entropy,
}
"""Values of `evaluation.norms` (`qs3.training.run.Judging`), beside "trained"."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a run.

    Attributes:
        net: the reported one.
        predictions: its, for each evaluated cloud; these and all scores are with
            `evaluation.prior`, estimates and validators without.
        prior: that one, of the reported net.
        choice: what chose its epoch; None: it is the last one's, or the warm-up's.
        final: its scores.
        scores: of "selected" and "last", the warm-up's epochs, and "student", the last round's.
        rotated: scores of the reported net and of "selected", averaged over rotations.
        validators: its label-free scores.
        quality: what can be said of it without labels.
        held_out: what it is on held-out labelled clouds; None of one that has diverged, or whose
            norms `evaluation.norms` changed.
        learnt: shares of the classes in what it learnt from.
        training: its accuracy on training clouds, with `data.clouds_a_class` alone.
    """

    net: nn.Module
    predictions: Predictions
    prior: Prior | None
    choice: StudentSelection | None
    final: Scores
    scores: Mapping[str, Scores]
    rotated: tuple[Scores | None, Scores | None]
    validators: dict[str, float | None]
    quality: Quality
    held_out: HeldOut | None
    learnt: Shares
    training: TrainingAccuracy | None


class SavedNets:
    """Nets with the weights in a run's files, and what they predict.

    Equal weights are one net, and each net predicts the same clouds once: without rounds, for one,
    the reported weights are those of the warm-up, and its last ones the student's.

    Args:
        run: whose they are.
        loaded: clouds, and the target's for norms and a prior that follow them.
        built: how a net is made, and where it runs.
    """

    def __init__(self, run: Run, loaded: Loaded, built: Built) -> None:
        self.run, self.data, self.test = run, loaded.data, loaded.evaluation.test
        self.classifier = built.classifier
        # After `fit` Lightning moves the classifier to the CPU; the accelerator is still there.
        self.device = built.trainer.strategy.root_device
        self._weights: dict[Path, str] = {}
        self._nets: dict[tuple[str, str], nn.Module] = {}
        self._predicted: dict[tuple[str, str, float], np.ndarray] = {}

    def __call__(self, file: Path) -> nn.Module:
        """As it is evaluated: with norms of the target if `evaluation.norms` says so."""
        return self._net(file, self.run.cfg.evaluation.norms)

    def of_test(
        self, file: Path, turn: float = 0.0, norms: str | None = None
    ) -> Float[np.ndarray, "n c"]:
        """Probabilities of the evaluated clouds, rotated about the up axis by `turn` in radians.

        `norms`: other ones than `evaluation.norms`.
        """
        norms = norms or self.run.cfg.evaluation.norms
        key = self._weights_in(file), f"test, {norms}", turn
        if key not in self._predicted:
            more = self._net(file, norms), self.test.points
            how: Any = self.run.cfg.data.eval_batch_size, self.device
            found = predict_rotated(*more, turn, *how) if turn else predict(*more, *how)
            self._predicted[key] = found
        return self._predicted[key]

    def of_target(self, file: Path) -> Float[np.ndarray, "n c"]:
        """Probabilities of the target's training clouds."""
        key = self._weights_in(file), "target", 0.0
        if key not in self._predicted:
            clouds, size = self.data.target.points, self.run.cfg.data.eval_batch_size
            self._predicted[key] = predict(self(file), clouds, size, self.device)
        return self._predicted[key]

    def of_validation(self, file: Path, norms: str | None = None) -> Float[np.ndarray, "v c"]:
        """Probabilities of the labelled validation clouds, with the norms for their domain.

        `norms`: of clouds of the target other ones than `evaluation.norms`.
        """
        of_source, clouds = self.data.owner == "source", self.data.validation.clouds
        norms = "trained" if of_source else norms or self.run.cfg.evaluation.norms
        key = self._weights_in(file), f"validation, {norms}", 0.0
        if key not in self._predicted:
            self._predicted[key] = predict(
                self._net(file, norms),
                clouds.points,
                self.run.cfg.data.eval_batch_size,
                self.device,
                domain="source" if of_source else "target",
            )
        return self._predicted[key]

    def _net(self, file: Path, norms: str) -> nn.Module:
        key = self._weights_in(file), norms
        if key not in self._nets:
            net = self.classifier.fresh_net(phase=0).to(self.device)
            net.load_state_dict(load(file, self.device))
            if norms != TRAINED:
                adapt = ADAPTERS[norms]
                size, seed = self.run.cfg.protocol.batch_size, derive(self.run.seed, norms)
                adapt(net, self.data.target.points, size, seed, self.device)
            self._nets[key] = net
        return self._nets[key]

    def _weights_in(self, file: Path) -> str:
        """A hash of the weights: files of equal ones need not be equal."""
        if file not in self._weights:
            self._weights[file] = weights_sha256(load(file))
        return self._weights[file]


def evaluate(run: Run, loaded: Loaded, built: Built) -> Outcome:
    """Score the warm-up's and the student's weights; of the reported ones say more."""
    nets, evaluation = SavedNets(run, loaded, built), loaded.evaluation
    names = {"selected": WARMUP_SELECTED, "last": WARMUP_LAST, "student": STUDENT}
    files = {name: run.folder / file for name, file in names.items()}
    choice = None if built.student.rule == LAST else built.student
    last = "student" if run.scheme.rounds else "selected"
    file = choice.file if choice else files[last]
    net, device = nets(file), nets.device

    learnt = loaded.learnt
    if run.scheme.rounds:
        learnt = shares_of_student(run.scheme, loaded.labelled, built.rounds.records[-1])

    @cache
    def prior_of(weights: Path) -> Prior | None:
        # A given teacher learnt elsewhere, but the warm-up's last net from the labelled clouds.
        warmups = {files["selected"]: loaded.learnt, files["last"]: loaded.labelled}
        met = warmups.get(weights, learnt)
        said = partial(nets.of_target, weights)
        return prior_beside(run.cfg.evaluation, evaluation.classes, met, said)

    def reported(weights: Path, turn: float = 0.0) -> Float[np.ndarray, "n c"]:
        found, prior = nets.of_test(weights, turn), prior_of(weights)
        return prior(found) if prior else found

    predictions = evaluation.predictions_of(reported(file))
    batch_size, data = run.cfg.data.eval_batch_size, loaded.data
    return Outcome(
        net=net,
        predictions=predictions,
        prior=prior_of(file),
        choice=choice,
        final=evaluation.scores_of(predictions.probabilities),
        scores={name: evaluation.scores_of(reported(path)) for name, path in files.items()},
        rotated=(
            evaluation.rotation_averaged(partial(reported, file)),
            evaluation.rotation_averaged(partial(reported, files["selected"])),
        ),
        validators=without_labels(nets.of_target(file), choice),
        quality=_quality(run, loaded, nets, file),
        held_out=(
            held_out(nets.of_validation(file), data.validation.labels.numpy())
            if run.cfg.evaluation.norms == TRAINED
            else None
        ),
        learnt=learnt,
        training=(
            training_accuracy(net, data.labelled, data.owner, batch_size, device)
            if run.cfg.data.clouds_a_class is not None
            else None
        ),
    )


def _quality(run: Run, loaded: Loaded, nets: SavedNets, file: Path) -> Quality:
    data, classes = loaded.data, loaded.evaluation.classes
    labels, table = data.validation.labels.numpy(), nets.of_test(file)
    # What adapts a net to these clouds makes it surer of them than it is right.
    before = run.folder / WARMUP_SELECTED if run.scheme.rounds else file
    known = held_out(nets.of_validation(before, TRAINED), labels)
    counts = np.bincount(table.argmax(axis=1), minlength=len(classes))
    return Quality(
        validation_accuracy=float((nets.of_validation(file).argmax(axis=1) == labels).mean()),
        expected=expected_accuracy(known, nets.of_test(before, norms=TRAINED)),
        unlike_source=ood_share(loaded.evaluation.test, data.all_labelled),
        never_predicted=[name for name, n in zip(classes, counts, strict=True) if not n],
    )


def without_labels(
    table: Float[np.ndarray, "n c"], choice: StudentSelection | None
) -> dict[str, float | None]:
    """The reported net's scores by `qs3.evaluation.validators`, on the target's training clouds.

    Args:
        table: what it says of them.
        choice: how it was chosen: if by `pseudo_val`, that score is here, too.

    Returns:
        Scores by name; None for one that is not a number, of a net that has diverged. SND needs two
        clouds.
    """
    scores = {
        name: one.score(table)
        for name, one in LABEL_FREE.items()
        if name != "snd" or len(table) > 1
    }
    if choice is not None and choice.rule == PSEUDO_VAL and choice.score is not None:
        scores[PSEUDO_VAL] = choice.score
    return {name: score if math.isfinite(score) else None for name, score in scores.items()}


def training_accuracy(
    net: nn.Module, labelled: Labelled, owner: str, batch_size: int, device: Any
) -> TrainingAccuracy:
    """How many clouds the reported net was trained on, and the share that is right.

    `owner`: of their labels, "source" or "target_train": whose norms the net takes for them.
    """
    domain = "source" if owner == "source" else "target"
    table = predict(net, labelled.clouds.points, batch_size, device, domain=domain)
    right = float((table.argmax(axis=1) == labelled.labels.numpy()).mean())
    log.info("%.1f %% of the %d training clouds are right", 100 * right, len(table))
    return TrainingAccuracy(n=len(table), accuracy=right)
