"""Last stage: the files of a finished run, and the contents of its `metrics.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from qs3.config import hashing
from qs3.config.hydra import component_names
from qs3.evaluation.ood import limits, ood_reasons_of_all, source_limits
from qs3.evaluation.validators import LAST
from qs3.inference.model_file import FILE as RESULT
from qs3.inference.model_file import Result, write_result
from qs3.runs.checkpoints import copy_weights
from qs3.runs.metrics import (
    DataHashes,
    EpochScores,
    Evaluated,
    Loading,
    RunMetrics,
    Selection,
    StudentChoice,
    Warmup,
)
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import (
    OF_FILES,
    pseudo_labels_path,
    write_predictions,
    write_predictions_of_files,
)
from qs3.store.manifest import read_manifest
from qs3.training.build import Built
from qs3.training.evaluate import Outcome
from qs3.training.load import Loaded
from qs3.training.run import Run


def write_outcome(run: Run, loaded: Loaded, built: Built, outcome: Outcome) -> RunMetrics:
    """Write the model file and the predictions; returns what `metrics.json` is to hold.

    That file is written last, by the caller: it marks the run as finished.
    """
    if built.trainer.is_global_zero:
        write_result(run.folder / RESULT, _result(run, loaded, outcome))
        write_predictions(run.folder / PREDICTIONS, outcome.predictions)
        if not loaded.evaluation.labelled:
            _write_of_files(run, loaded, outcome)
    return _metrics(run, loaded, built, outcome)


def _metrics(run: Run, loaded: Loaded, built: Built, outcome: Outcome) -> RunMetrics:
    cfg, data, evaluation = run.cfg, loaded.data, loaded.evaluation
    over, before = outcome.rotated
    names = component_names(cfg)
    return RunMetrics(
        experiment=cfg.experiment_name,
        hash=hashing.config_hash(cfg),
        config_sha256=hashing.config_sha256(cfg),
        seed=run.seed,
        source=data.labelled_domain.domain.name,
        target=run.target.name,
        simulated=bool(run.target.simulated),
        method=names["method"],
        selftraining=names["selftraining"],
        model=names["model"],
        selection=_selection(run, loaded, built, outcome),
        loading=Loading(
            points=cfg.data.points,
            scale=cfg.data.scale,
            fps_starts=data.labelled.clouds.starts,
            sampler=cfg.data.sampler,
        ),
        final=outcome.final,
        evaluation=Evaluated(
            split=loaded.split,
            labels=evaluation.labelled,
            rotations=evaluation.rotations,
            norms=cfg.evaluation.norms,
            prior=outcome.prior.words if outcome.prior else "",
            prior_shares=outcome.prior.shares if outcome.prior else None,
            final_over_rotations=over,
            warmup_over_rotations=before,
            tiers=evaluation.scores_of_tiers(outcome.predictions.probabilities),
        ),
        warmup=Warmup(
            selected=EpochScores(epoch=built.warmup.epoch, scores=outcome.scores["selected"]),
            last=EpochScores(epoch=run.phases.warmup - 1, scores=outcome.scores["last"]),
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
        student=_student(run, outcome),
        validators=outcome.validators,
        quality=outcome.quality,
        training=outcome.training,
        data=DataHashes(**loaded.started["data"]),
        made_of=loaded.made_of,
        times=built.clock.taken(),
        versions=_versions(loaded.started),
    )


def _selection(run: Run, loaded: Loaded, built: Built, outcome: Outcome) -> Selection:
    """Which weights labelled the target first and which are reported, as text."""
    rule = built.warmup.rule
    if rule == "source_val":
        rule = f"{loaded.data.owner}_val"
    teacher = f"{rule}, epoch {built.warmup.epoch}"
    if rule == "given":
        teacher = f"given, {loaded.started['versions']['weights'].rpartition(' ')[0]}"
    student = outcome.choice.in_words if outcome.choice else LAST
    return Selection(
        teacher=teacher,
        student=student if run.scheme.rounds else teacher,
        validation=run.cfg.data.val,
    )


def _versions(started: Mapping[str, Any]) -> dict[str, str]:
    """With the checkout's commit, if the run was begun in one."""
    commit = started.get("commit")
    return {**started["versions"], **({"commit": commit} if commit else {})}


def _student(run: Run, outcome: Outcome) -> StudentChoice | None:
    if outcome.choice is None:
        return None
    last = EpochScores(epoch=run.phases.total - 1, scores=outcome.scores["student"])
    return StudentChoice(**outcome.choice.record(), last=last)


def _result(run: Run, loaded: Loaded, outcome: Outcome) -> Result:
    """What is reported, with all that using it elsewhere takes."""
    model: Any = OmegaConf.to_container(run.cfg.model, resolve=True)
    if "sha256" in model:  # of a file, as of model=features: whoever loads it may stand elsewhere
        model["file"] = str(Path(model["file"]).expanduser().absolute())
    return Result(
        model=model,
        classes=loaded.evaluation.classes,
        points=run.cfg.data.points,
        stored_points=loaded.stored_points,
        target=run.target.name,
        gravity=run.target.gravity,
        scale=run.cfg.data.scale,
        usual=limits(loaded.data.all_labelled, loaded.data.target),
        weights=copy_weights(outcome.net),
        floor_m=_floor(run),
        held_out=outcome.held_out,
        learnt=tuple(outcome.learnt.tolist()),
    )


def _floor(run: Run) -> float | None:
    floor = run.target.floor_m
    return float(floor) if run.cfg.data.scale == "above_floor" and floor is not None else None


def _write_of_files(run: Run, loaded: Loaded, outcome: Outcome) -> None:
    """The predictions by the names of the user's files, with what is odd about each cloud."""
    rows = read_manifest(run.target.folder, loaded.evaluation.classes)
    origins = {row.id: row.origin for row in rows if row.origin}
    test = loaded.evaluation.test
    strange = ood_reasons_of_all(test, source_limits(loaded.data.all_labelled))
    write_predictions_of_files(
        run.folder / OF_FILES,
        [origins.get(id_, id_) for id_ in test.ids],
        ["; ".join(each) for each in strange],
        outcome.predictions,
    )
