"""The training story: data, classifier, callbacks, one `Trainer.fit`, and what came of it."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback
from omegaconf import DictConfig, OmegaConf
from torch import nn

from qs3.config import hashing
from qs3.config.hydra import build, called
from qs3.data.domain import Domain
from qs3.data.manifest import read_manifest
from qs3.data.store import PointSet
from qs3.datamodules.adaptation import (
    Labelled,
    UdaData,
    Unlabelled,
    few_of_each_split,
    first_of_each_class,
    labels_of,
    load_clouds,
    with_labels,
)
from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.engine.loggers import CsvHistory, EpochRows
from qs3.engine.trainer import build_each, make_trainer, quieten
from qs3.engine.wall_time import Clock
from qs3.errors import ConfigError, DataError
from qs3.evaluation.accuracy_estimates import quality_of, usual_of
from qs3.evaluation.metrics import Evaluation, adapt_norms
from qs3.evaluation.ood import limits, strange_clouds
from qs3.evaluation.selection_rules import LAST as LAST_EPOCH
from qs3.inference.model_file import FILE as RESULT
from qs3.inference.model_file import Result, write_result
from qs3.methods.base import Method
from qs3.runs.checkpoints import LAST, AtomicCheckpointIO, SaveLast, copy_weights, load, save
from qs3.runs.predictions import FILE as PREDICTIONS
from qs3.runs.predictions import (
    OF_FILES,
    Predictions,
    write_predictions,
    write_predictions_of_files,
)
from qs3.runs.pseudo_labels import path_of
from qs3.selftraining.callback import WARMUP_LAST, WARMUP_SELECTED, SelfTraining, WarmupSelection
from qs3.selftraining.student_loss import Student
from qs3.selftraining.student_selection import Choice, StudentSelection
from qs3.training.final_scores import learnt_by_heart, without_labels
from qs3.training.provenance import note_start
from qs3.training.resume import take_checkpoint
from qs3.training.run import Run
from qs3.training.shared_warmup import SharedWarmup, warmup_sha256
from qs3.utils.seeding import derive

log = logging.getLogger(__name__)

STUDENT = "student.pt"


def fit(run: Run) -> dict[str, Any]:
    """Train a run in its folder, from its last checkpoint on if there is one.

    Returns:
        The contents of `metrics.json`: the same whenever the run is repeated on this machine,
        interrupted or not, except what stands under "times".
    """
    began, cfg = time.time(), run.cfg
    quieten()
    torch.set_num_threads(cfg.trainer.threads or os.cpu_count() or 1)
    source_set, target_set = run.source.open(), run.target.open()
    _check_classes(source_set, target_set, cfg.num_classes)
    started = note_start(run, source_set, target_set)
    cache = Path(cfg.data.cache_dir) if cfg.data.cache_dir else None
    if (few := cfg.data.clouds_a_split) is not None:
        source_set, target_set = (
            few_of_each_split(source_set, few),
            few_of_each_split(target_set, few),
        )
        cache = None  # which is of whole splits

    # 1. Data. Target labels go to the method that asks for them by name, and to the evaluation.
    method: Method = build(cfg.method)
    load_split = partial(load_clouds, points=cfg.data.points, cache_dir=cache)
    target = load_split(target_set, "train", starts=cfg.data.fps_starts)
    supervised = method.labels == "target_train"
    if supervised:
        labelled = with_labels(target, target_set, "train", "method=supervised")
    else:
        clouds = load_split(source_set, "train", starts=cfg.data.fps_starts)
        labelled = with_labels(clouds, source_set, "train", "data.source")
    if cfg.data.clouds_a_class is not None:
        labelled = first_of_each_class(labelled, cfg.data.clouds_a_class)
    data = UdaData(
        labelled,
        target,
        phases=run.phases,
        scheme=run.scheme,
        augment=build(cfg.protocol.augment),
        batch_size=cfg.protocol.batch_size,
        seed=run.seed,
        owner=method.labels,
        val=cfg.data.val,
        sampler=cfg.data.sampler,
        eval_batch_size=cfg.data.eval_batch_size,
        uses_target=method.uses_target,
    )
    split = _evaluated_split(target_set)
    judged = load_split(target_set, split)
    evaluation = Evaluation(
        judged,
        labels_of(target_set, split) if split == "test" else None,
        _labels_by_id(target_set, "train"),
        target_set.classes,
        cfg.data.eval_batch_size,
        cfg.evaluation.rotations,
        _objects_by_id(target_set, run.target),
    )
    if not cfg.force:
        take_checkpoint(run, started)

    # 2. Classifier and callbacks.
    classifier = Classifier(
        build_net=lambda: build(cfg.model),
        build_optimizer=build(cfg.protocol.optimizer),
        method=method,
        student=Student(
            run.scheme.pcm, run.scheme.weight_step, run.scheme.mrkld, run.phases.warmup
        ),
        phases=run.phases,
        seed=run.seed,
        schedule=cfg.protocol.schedule,
        smoothing=cfg.protocol.smoothing,
        regulariser_weight=cfg.protocol.regulariser,
    )
    if cfg.compile:
        classifier.net.compile()  # in place; nets that are only evaluated stay as they are
    warmup = WarmupSelection(run.folder, run.phases, cfg.selection.teacher)
    rounds = SelfTraining(run.folder, run.phases, run.scheme, target_set.classes)
    student = StudentSelection(run.folder, run.phases, cfg.selection.student, target_set.classes)
    shared = SharedWarmup(
        run.folder,
        cfg.paths.warmup_dir,
        warmup_sha256(cfg, started),
        run.seed,
        run.phases.warmup,
    )
    saving = [SaveLast(run.folder), shared]  # in this order
    clock = Clock(began)
    callbacks: list[Callback] = [warmup, rounds, student, EpochRows(run.phases), clock, *saving]

    # 3. One fit over all phases. A checkpoint lies between two epochs; a resume repeats an epoch.
    trainer = make_trainer(
        cfg,
        max_epochs=run.phases.total,
        callbacks=[*build_each(cfg.callbacks), *callbacks],
        logger=[CsvHistory(run.folder), *build_each(cfg.logger)],
        plugins=[AtomicCheckpointIO()],
        default_root_dir=run.folder,
    )
    for logger in trainer.loggers:
        logger.log_hyperparams(_settings(cfg))
    if not cfg.force and int(os.environ.get("LOCAL_RANK", 0)) == 0:
        shared.take()
    last = run.folder / LAST
    log.info(
        "%s, %d epochs", "fitting, continued" if last.is_file() else "fitting", run.phases.total
    )
    trainer.fit(classifier, data, ckpt_path=last if last.is_file() else None, weights_only=True)

    # 4. What came of it, from saved weights: the same after any interruption.
    if trainer.is_global_zero:
        save(copy_weights(classifier.net), run.folder / STUDENT)
    trainer.strategy.barrier("student saved")

    def trained(file: Path, norms: str = cfg.evaluation.norms) -> nn.Module:
        net = classifier.fresh_net(phase=0).to(classifier.device)
        net.load_state_dict(load(file, classifier.device))
        if norms == "adabn":
            seed = derive(run.seed, "adabn")
            adapt_norms(net, target.points, cfg.protocol.batch_size, seed, classifier.device)
        return net

    final = "student" if run.scheme.rounds else "selected"
    names = {"selected": WARMUP_SELECTED, "last": WARMUP_LAST, "student": STUDENT}
    files = {name: run.folder / file for name, file in names.items()}
    choice = None  # the last epoch's student
    if student.rule != LAST_EPOCH:
        choice = student.choice()
    if choice is not None:
        final, files["chosen"] = "chosen", choice.file
    scores, turned = {}, {}
    quality: dict[str, Any] = {}
    extras: dict[str, Any] = {}
    for name, file in files.items():
        net = trained(file)
        scores[name] = evaluation.figures(net, classifier.device)
        if name in (final, "selected"):
            turned[name] = evaluation.turned(net, classifier.device)
        if name == final:
            more = data.eval_batch_size, classifier.device
            extras["validators"] = without_labels(net, target, choice, *more)
            if cfg.data.clouds_a_class is not None:
                extras["training"] = learnt_by_heart(net, data.labelled, method.labels, *more)
            taught = files["selected"] if run.scheme.rounds else None
            as_trained = None
            if cfg.evaluation.norms == "adabn":
                as_trained = trained(file, ""), trained(taught, "") if taught else None
            quality = quality_of(
                net,
                judged,
                data.validation,
                labelled.clouds,
                owner=method.labels,
                classes=target_set.classes,
                batch_size=cfg.data.eval_batch_size,
                device=classifier.device,
                teacher=trained(taught) if taught else None,
                unadapted=as_trained,
                upright=run.target.gravity == "z",
            )
        if name == final and trainer.is_global_zero:
            usual = limits(labelled.clouds, target.clouds)
            write_result(run.folder / RESULT, _result(run, target_set, net, usual))
            predictions = evaluation.predictions(net, classifier.device)
            write_predictions(run.folder / PREDICTIONS, predictions)
            if evaluation.y_target_eval is None:
                _write_of_files(run, target_set, judged, labelled, predictions)
    validated_on = f"{method.labels}_val"
    teacher = (
        f"{validated_on if warmup.rule == 'source_val' else warmup.rule}, epoch {warmup.epoch}"
    )
    reported = teacher if not run.scheme.rounds else choice.in_words if choice else LAST_EPOCH
    return {
        "experiment": cfg.experiment_name,
        "hash": hashing.config_hash(cfg),
        "config_sha256": hashing.config_sha256(cfg),
        "seed": run.seed,
        "status": "finished",
        "source": run.target.name if supervised else run.source.name,
        "target": run.target.name,
        "simulated": bool(run.target.simulated),
        **called(cfg),
        "selection": {
            "teacher": teacher,
            "student": reported,
            "validation": cfg.data.val,
        },
        "loading": {
            "points": cfg.data.points,
            "fps_starts": labelled.clouds.starts,
            "sampler": cfg.data.sampler,
        },
        "final": scores[final],
        "evaluation": {
            "split": split,
            "labels": evaluation.y_target_eval is not None,
            "rotations": evaluation.rotations,
            "norms": cfg.evaluation.norms,
            "final_over_rotations": turned[final],
            "warmup_over_rotations": turned["selected"],
        },
        "warmup": {
            "selected": {**scores["selected"], "epoch": warmup.epoch},
            "last": {**scores["last"], "epoch": run.phases.warmup - 1},
        },
        "rounds": [
            {
                **record,
                "with_target_labels": evaluation.pseudo_labels(
                    path_of(run.folder, record["round"])
                ),
            }
            for record in rounds.records
        ],
        **_students(choice, run.phases, scores),
        **extras,
        "quality": quality,
        "data": started["data"],
        "times": {"seconds": round(clock.seconds(), 1)},
        "versions": started["versions"],
    }


def _result(run: Run, target: PointSet, net: nn.Module, usual: Mapping[str, list[float]]) -> Result:
    """What is reported, with all that using it elsewhere takes."""
    model: Any = OmegaConf.to_container(run.cfg.model, resolve=True)
    return Result(
        model=model,
        classes=tuple(target.classes),
        points=run.cfg.data.points,
        stored_points=target.points.shape[1],
        target=run.target.name,
        gravity=run.target.gravity,
        usual=usual,
        weights=copy_weights(net),
    )


def _check_classes(source: PointSet, target: PointSet, num_classes: int) -> None:
    if source.classes != target.classes:
        raise DataError(
            f"{source.name} has the classes {source.classes}, {target.name} {target.classes}; "
            "they must be the same, in the same order"
        )
    if len(source.classes) != num_classes:
        raise ConfigError(
            f"num_classes is {num_classes}, but {source.name} has {len(source.classes)} classes; "
            f"set num_classes={len(source.classes)}"
        )


def _evaluated_split(target: PointSet) -> str:
    """The test split; the training split if there is no other, e.g. of somebody's own scans."""
    if "test" in target.counts():
        if labels_of(target, "test") is None:
            log.warning("%s has no labels: no accuracy, only counts of predictions", target.name)
        return "test"
    log.warning(
        "%s has no test split: no accuracy, only counts of predictions for its training clouds",
        target.name,
    )
    return "train"


def _labels_by_id(dataset: PointSet, split: str) -> dict[str, int] | None:
    labels = labels_of(dataset, split)
    if labels is None:
        return None
    return dict(zip(dataset.split(split).ids, labels.tolist(), strict=True))


def _objects_by_id(dataset: PointSet, domain: Domain) -> dict[str, str]:
    """What each cloud shows: its mesh, or what the publisher's ids tell; where that is known."""
    importer = domain.importer()
    of_id = importer.object_of if importer else lambda _: ""
    rows = read_manifest(domain.folder, dataset.classes)
    known = {row.id: row.mesh_sha256 or of_id(row.id) for row in rows}
    return {id_: name for id_, name in known.items() if name}


def _students(choice: Choice | None, phases: Phases, scores: Mapping[str, Any]) -> dict[str, Any]:
    """How the reported student was chosen, beside the last epoch's; {} if it is the last one."""
    if choice is None:
        return {}
    last = {**scores["student"], "epoch": phases.total - 1}
    return {"student": {**choice.record(), "selected": scores["chosen"], "last": last}}


def _write_of_files(
    run: Run, target: PointSet, judged: Unlabelled, labelled: Labelled, predictions: Predictions
) -> None:
    """The predictions by the names of the user's files, with what is odd about each cloud."""
    rows = read_manifest(run.target.folder, target.classes)
    origins = {row.id: row.origin for row in rows if row.origin}
    strange = strange_clouds(judged.clouds, usual_of(labelled.clouds))
    write_predictions_of_files(
        run.folder / OF_FILES,
        [origins.get(id_, id_) for id_ in judged.ids],
        ["; ".join(each) for each in strange],
        predictions,
    )


def _settings(cfg: DictConfig) -> dict[str, Any]:
    """The composed config, for loggers that show it."""
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return settings
