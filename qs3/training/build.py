"""Second stage: classifier, callbacks and trainer from the run's config."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import (
    EarlyStopping,
    StochasticWeightAveraging,
    Timer,
    WeightAveraging,
)
from lightning.pytorch.plugins.environments import LightningEnvironment
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.engine.checkpointing import AtomicCheckpointIO, Clock, SaveLast
from qs3.engine.classifier import Classifier
from qs3.engine.loggers import CsvHistory, EpochRows
from qs3.engine.trainer import build_each, let_weights_rest, make_trainer
from qs3.errors import ConfigError
from qs3.kernels.norms import DomainNorm, check_has_norms
from qs3.methods.base import Method, feature_dims
from qs3.selftraining.callback import SelfTraining, WarmupSelection
from qs3.selftraining.student_loss import Student
from qs3.selftraining.student_selection import StudentSelection
from qs3.training.given import Given
from qs3.training.load import Loaded
from qs3.training.provenance import is_as_begun
from qs3.training.run import Run
from qs3.training.shared_warmup import SharedWarmup, warmup_sha256
from qs3.utils.processor_time import Moment


@dataclass(frozen=True, eq=False)
class Built:
    """The trainer, and the callbacks that evaluation asks afterwards."""

    trainer: Trainer
    classifier: Classifier
    warmup: WarmupSelection
    rounds: SelfTraining
    student: StudentSelection
    shared_warmup: SharedWarmup
    clock: Clock


def build_training(
    run: Run, method: Method, loaded: Loaded, given: Given | None, began: Moment
) -> Built:
    """Everything that `Trainer.fit` needs but the data.

    `loaded`: for class names, and the hash of what the warm-up depends on; `given`: the classifier
    to begin with; `began`: when the run started.
    """
    cfg, folder, phases = run.cfg, run.folder, run.phases
    added = _callbacks(cfg)
    classifier = _classifier(run, method, given)
    classes = loaded.evaluation.classes
    warmup = WarmupSelection(folder, phases, cfg.selection.teacher)
    was_given = cfg.selection.teacher == "given"
    rounds = SelfTraining(folder, phases, run.scheme, classes, was_given)
    student = StudentSelection(
        folder, phases, cfg.selection.student, classes, run.scheme.more_labels
    )
    # A warm-up of two versions is nobody else's.
    sharing = cfg.paths.warmup_dir if is_as_begun(loaded.started, cfg) else None
    shared = SharedWarmup(
        folder, sharing, warmup_sha256(cfg, loaded.started), run.seed, phases.warmup
    )
    clock = Clock(began)
    # In this order: rounds select before the student is scored, and all is done before it is saved.
    callbacks: list[Callback] = [
        *(warmup, rounds, student, EpochRows(phases), clock),
        *(SaveLast(folder), shared),
    ]
    trainer = make_trainer(
        cfg,
        max_epochs=phases.total,
        callbacks=[*added, *callbacks],
        logger=[CsvHistory(folder), *build_each(cfg.get("logger"))],
        # In a job of SLURM Lightning would take its tasks, mostly one, for the processes.
        plugins=[AtomicCheckpointIO(), LightningEnvironment()],
        default_root_dir=folder,
    )
    if any(isinstance(module, DomainNorm) for module in classifier.net.modules()):
        let_weights_rest(trainer)  # an epoch may see one of the domains alone
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    for logger in trainer.loggers:
        logger.log_hyperparams(settings)
    return Built(trainer, classifier, warmup, rounds, student, shared, clock)


def _callbacks(cfg: DictConfig) -> list[Callback]:
    """Those of config group `callbacks`, beside what training needs.

    Raises:
        ConfigError: one would end the run before its phases do, or change weights after they have
            been selected and saved.
    """
    added = build_each(cfg.get("callbacks"))
    for one in added:
        if isinstance(one, EarlyStopping | Timer):
            raise ConfigError(
                f"callbacks: {type(one).__name__} ends a training early, and a run is its warm-up "
                "and its rounds; set protocol.epochs and protocol.steps, selftraining.rounds, "
                ".epochs and .steps, or selection.teacher=source_val, which takes the best epoch"
            )
        if isinstance(one, StochasticWeightAveraging | WeightAveraging):
            raise ConfigError(
                f"callbacks: {type(one).__name__} averages weights beside the net's, and each "
                "epoch's own are selected, label the target and are reported; leave it out"
            )
    return added


def _classifier(run: Run, method: Method, given: Given | None) -> Classifier:
    cfg, scheme = run.cfg, run.scheme
    classifier = Classifier(
        build_net=lambda: build(cfg.model),
        build_optimizer=build(cfg.protocol.optimizer),
        method=method,
        student=Student(scheme.pcm, scheme.weight_step, scheme.mrkld, run.phases.warmup),
        phases=run.phases,
        seed=run.seed,
        schedule=cfg.protocol.schedule,
        smoothing=cfg.protocol.smoothing,
        metres=cfg.data.scale == "metres",
        regulariser_weight=cfg.protocol.regulariser,
        weights=given.weights if given else None,
        cuda_graphs=cfg.trainer.get("cuda_graphs", True) and not cfg.compile,
    )
    if cfg.evaluation.norms != "trained":
        check_has_norms(classifier.net, cfg.evaluation.norms)
    if scheme.rounds and getattr(scheme.selector, "needs_features", False):
        feature_dims(classifier.net)
    if cfg.compile:
        classifier.net.compile()  # in place; nets that are only evaluated stay as they are
    return classifier
