"""Last stage: what the nets of a run are worth, from the weights that it saved; its result."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf
from torch import nn

from qs3.config.hydra import component_names, config_hash, config_sha256
from qs3.evaluation.metrics import predict
from qs3.evaluation.norms import adapt_norms, minimise_entropy
from qs3.evaluation.ood import limits, ood_reasons_of_all, ood_share, source_limits
from qs3.evaluation.prior import Prior
from qs3.evaluation.validators import infomax
from qs3.inference.model_file import FILE as RESULT
from qs3.inference.model_file import Result, write_result
from qs3.runs.checkpoints import copy_weights, load, weights_sha256
from qs3.runs.metrics import (
    DataHashes,
    EpochScores,
    Evaluated,
    Loading,
    Quality,
    RunMetrics,
    Selection,
    Warmup,
)
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import (
    OF_FILES,
    Predictions,
    pseudo_labels_path,
    write_predictions,
    write_predictions_of_files,
)
from qs3.selftraining.callback import WARMUP_LAST, WARMUP_SELECTED, WarmupSelection
from qs3.store.meta import read_manifest
from qs3.store.store import HEIGHTS
from qs3.training.fit import Built
from qs3.training.load import Loaded, Shares, prior_beside, shares_of_student
from qs3.training.run import STUDENT, Run
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

TRAINED = "trained"
ADAPTERS: dict[str, Callable[..., None]] = {
    "adabn": adapt_norms,
    "alpha_bn": partial(adapt_norms, kept=0.5),  # why half: docs/results/index.md
    "tent": minimise_entropy,
}
"""Values of `evaluation.norms` (`qs3.training.run.Judging`), besides "trained"."""


class SavedNets:
    """Nets with the weights in a run's files, and what they predict.

    Equal weights are one net, and each net predicts the same clouds once: without rounds, for one,
    the reported weights are those of the warm-up, and its last ones the student's.
    """

    def __init__(self, run: Run, loaded: Loaded, built: Built) -> None:
        self.run, self.data = run, loaded.data
        self.clouds = {
            "test": loaded.evaluation.test,
            "target": loaded.data.target,  # the training clouds
            "validation": loaded.data.validation.clouds,
        }
        self.classifier = built.classifier
        # After `fit` Lightning moves the classifier to the CPU; the accelerator is still there.
        self.device = built.trainer.strategy.root_device
        self._nets: dict[tuple[str, str], nn.Module] = {}
        self._predicted: dict[tuple[str, str, str], Float[np.ndarray, "n c"]] = {}
        self._weights_in = cache(lambda file: weights_sha256(load(file)))  # equal ones are one net

    def __call__(self, file: Path, norms: str | None = None) -> nn.Module:
        """As it is evaluated: with norms of the target if `norms` or `evaluation.norms` says so."""
        norms = norms or self.run.cfg.evaluation.norms
        key = self._weights_in(file), norms
        if key not in self._nets:
            net = self.classifier.fresh_net(phase=0).to(self.device)
            net.load_state_dict(load(file, self.device))
            if norms != TRAINED:
                size, seed = self.run.cfg.protocol.batch_size, derive(self.run.seed, norms)
                ADAPTERS[norms](net, self.data.target.points, size, seed, self.device)
            self._nets[key] = net
        return self._nets[key]

    def of(self, which: str, file: Path) -> Float[np.ndarray, "n c"]:
        """Probabilities of some of the `clouds` by a file's weights, with their domain's norms."""
        norms, domain = self.run.cfg.evaluation.norms, "target"
        if which == "validation" and self.data.owner == "source":
            norms, domain = TRAINED, "source"
        key = self._weights_in(file), which, norms
        if key not in self._predicted:
            more = self(file, norms), self.clouds[which].points
            how = self.run.cfg.data.eval_batch_size, self.device
            self._predicted[key] = predict(*more, *how, domain=domain)
        return self._predicted[key]


def evaluate(run: Run, loaded: Loaded, built: Built) -> RunMetrics:
    """Score the warm-up's and the student's weights; write the model file and the predictions.

    Scores and predictions are with `evaluation.prior`, validators without.

    Returns:
        What `metrics.json` is to hold. The caller writes it last: it marks a run as finished.
    """
    cfg, data, evaluation = run.cfg, loaded.data, loaded.evaluation
    nets = SavedNets(run, loaded, built)
    names = {"selected": WARMUP_SELECTED, "last": WARMUP_LAST, "student": STUDENT}
    files = {name: run.folder / file for name, file in names.items()}
    file = files["student" if run.scheme.rounds else "selected"]
    learnt = loaded.learnt
    if run.scheme.rounds:
        learnt = shares_of_student(run.scheme, loaded.labelled, built.rounds.records[-1])

    @cache
    def prior_of(weights: Path) -> Prior | None:
        # A given teacher learnt elsewhere, but the warm-up's last net from the labelled clouds.
        warmups = {files["selected"]: loaded.learnt, files["last"]: loaded.labelled}
        shares, probabilities = warmups.get(weights, learnt), partial(nets.of, "target", weights)
        return prior_beside(cfg.evaluation, evaluation.classes, shares, probabilities)

    def reported(weights: Path) -> Float[np.ndarray, "n c"]:
        found, prior = nets.of("test", weights), prior_of(weights)
        return prior(found) if prior else found

    scores = {name: evaluation.scores_of(reported(path)) for name, path in files.items()}
    predictions = evaluation.predictions_of(reported(file))
    prior, parts, score = prior_of(file), component_names(cfg), infomax(nets.of("target", file))
    metrics = RunMetrics(
        experiment=cfg.experiment_name,
        hash=config_hash(cfg),
        config_sha256=config_sha256(cfg),
        seed=run.seed,
        source=data.labelled_domain.domain.name,
        target=run.target.name,
        simulated=bool(run.target.simulated),
        method=parts["method"],
        selftraining=parts["selftraining"],
        model=parts["model"],
        selection=_selection(run, loaded, built.warmup),
        loading=Loading(
            points=cfg.data.points,
            scale=cfg.data.scale,
            fps_starts=data.labelled.clouds.starts,
            sampler=cfg.data.sampler,
        ),
        final=evaluation.scores_of(predictions.probabilities),
        evaluation=Evaluated(
            split=loaded.split,
            labels=evaluation.labelled,
            norms=cfg.evaluation.norms,
            prior=prior.words if prior else "",
            prior_shares=prior.shares if prior else None,
            tiers=evaluation.scores_of_tiers(predictions.probabilities),
        ),
        warmup=Warmup(
            selected=EpochScores(epoch=built.warmup.epoch, scores=scores["selected"]),
            last=EpochScores(epoch=run.phases.warmup - 1, scores=scores["last"]),
        ),
        rounds=[
            replace(
                record,
                with_target_labels=evaluation.pseudo_labels(
                    pseudo_labels_path(run.folder, record.round)
                ),
            )
            for record in built.rounds.records
        ],
        infomax=score if math.isfinite(score) else None,
        quality=_quality(loaded, nets, file),
        data=DataHashes(**loaded.started["data"]),
        made_of=loaded.made_of,
        times=built.clock.taken(),
        versions=loaded.started["versions"]
        | ({"commit": commit} if (commit := loaded.started.get("commit")) else {}),
    )
    if built.trainer.is_global_zero:
        _write(run, loaded, nets, file, learnt, predictions, metrics.data_text)
    return metrics


def _selection(run: Run, loaded: Loaded, warmup: WarmupSelection) -> Selection:
    """Which weights labelled the target first and which are reported, as text."""
    rule = f"{loaded.data.owner}_val" if warmup.rule == "source_val" else warmup.rule
    teacher = f"{rule}, epoch {warmup.epoch}"
    if rule == "given":
        teacher = f"given, {loaded.started['versions']['weights'].rpartition(' ')[0]}"
    return Selection(teacher=teacher, student="last" if run.scheme.rounds else teacher)


def _quality(loaded: Loaded, nets: SavedNets, file: Path) -> Quality:
    data, classes = loaded.data, loaded.evaluation.classes
    labels, table = data.validation.labels.numpy(), nets.of("test", file)
    counts = np.bincount(table.argmax(axis=1), minlength=len(classes))
    right = nets.of("validation", file).argmax(axis=1) == labels
    return Quality(
        validation_accuracy=float(right.mean()),
        unlike_source=ood_share(loaded.evaluation.test, data.all_labelled),
        never_predicted=[name for name, n in zip(classes, counts, strict=True) if not n],
    )


def _write(
    run: Run,
    loaded: Loaded,
    nets: SavedNets,
    file: Path,
    learnt: Shares,
    predictions: Predictions,
    made_of: str,
) -> None:
    """What is reported, with all that using it elsewhere takes, and what it predicts."""
    cfg, data, evaluation = run.cfg, loaded.data, loaded.evaluation
    model: Any = OmegaConf.to_container(cfg.model, resolve=True)
    floor = run.target.floor_m if cfg.data.scale in HEIGHTS else None
    result = Result(
        model=model,
        classes=evaluation.classes,
        points=cfg.data.points,
        stored_points=loaded.stored_points,
        target=run.target.name,
        gravity=run.target.gravity,
        scale=cfg.data.scale,
        usual=limits(data.all_labelled, data.target),
        weights=copy_weights(nets(file)),
        floor_m=None if floor is None else float(floor),
        data=made_of,
        learnt=tuple(learnt.tolist()),
    )
    write_result(run.folder / RESULT, result)
    write_predictions(run.folder / PREDICTIONS, predictions)
    if not evaluation.labelled:  # by the names of the user's files, with what is odd about each
        rows = read_manifest(run.target.folder)
        origins = {row.id: row.origin for row in rows if row.origin}
        strange = ood_reasons_of_all(evaluation.test, source_limits(data.all_labelled))
        write_predictions_of_files(
            run.folder / OF_FILES,
            [origins.get(id_, id_) for id_ in evaluation.test.ids],
            ["; ".join(each) for each in strange],
            predictions,
        )
