"""Second stage: classifier, callbacks and trainer from the run's config."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lightning.pytorch import Callback, Trainer
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.engine.checkpointing import AtomicCheckpointIO, Clock, SaveLast
from qs3.engine.classifier import Classifier
from qs3.engine.loggers import CsvHistory, EpochRows
from qs3.kernels.norms import DomainNorm, check_has_norms
from qs3.methods.base import Method, feature_dims
from qs3.selftraining.callback import SelfTraining, WarmupSelection
from qs3.selftraining.student_selection import Student, StudentSelection
from qs3.training.given import Given
from qs3.training.load import Loaded
from qs3.training.provenance import changed
from qs3.training.run import Run
from qs3.training.shared_warmup import SharedWarmup, warmup_sha256
from qs3.utils.processor import Moment

_OURS = ("threads", "gpus", "cuda_graphs", "float32_matmul")


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
    classifier = _classifier(run, method, given)
    warmup = WarmupSelection(folder, phases, cfg.selection.teacher)
    rounds = SelfTraining(folder, phases, run.scheme, loaded.evaluation.classes)
    student = StudentSelection(folder, phases, cfg.selection.student)
    # Nobody else can use a warm-up of two versions.
    sharing = None if changed(loaded.started) else cfg.paths.warmup_dir
    sha256 = warmup_sha256(cfg, loaded.started)
    shared = SharedWarmup(folder, sharing, sha256, run.seed, phases.warmup)
    clock = Clock(began)
    # In this order: rounds select before the student is scored, and all is done before it is saved.
    callbacks: list[Callback] = [
        *(warmup, rounds, student, EpochRows(phases), clock),
        *(SaveLast(folder), shared),
    ]
    trainer = _make_trainer(
        cfg,
        max_epochs=phases.total,
        callbacks=[*_build_each(cfg.get("callbacks")), *callbacks],
        logger=[CsvHistory(folder), *_build_each(cfg.get("logger"))],
        # In a job of SLURM Lightning would take its tasks, mostly one, for the processes.
        plugins=[AtomicCheckpointIO(), LightningEnvironment()],
        default_root_dir=folder,
    )
    if any(isinstance(module, DomainNorm) for module in classifier.net.modules()):
        _let_weights_rest(trainer)  # an epoch may see one of the domains alone
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    for logger in trainer.loggers:
        logger.log_hyperparams(settings)
    return Built(trainer, classifier, warmup, rounds, student, shared, clock)


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
        feature_dims(classifier.net)  # before the warm-up, not after it
    if cfg.compile:
        classifier.net.compile()  # in place; nets that are only evaluated stay as they are
    return classifier


def _make_trainer(cfg: DictConfig, **more: Any) -> Trainer:
    """Lightning's trainer by config group `trainer`; `more`: arguments that follow from the run."""
    settings: Any = OmegaConf.to_container(cfg.trainer, resolve=True)
    given = {key: value for key, value in settings.items() if key not in _OURS}
    if isinstance(given.get("profiler"), dict):
        given["profiler"] = build(cfg.trainer.profiler)
    return Trainer(
        **given,
        **more,
        reload_dataloaders_every_n_epochs=1,  # each epoch has its own order; rounds, their set
        use_distributed_sampler=False,  # `Batches` shares the clouds out itself
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        enable_progress_bar=False,  # `qs3.engine.loggers` shows all epochs in one bar
        enable_model_summary=False,
    )


def _let_weights_rest(trainer: Trainer) -> None:
    """Of several processes (DDP): a step need not use all weights; the others have no gradient.

    As in one process. Without it DDP waits for all, and 0 in place of none would be decayed.
    """
    if isinstance(trainer.strategy, DDPStrategy):
        trainer.strategy._ddp_kwargs["find_unused_parameters"] = True


def _build_each(group: DictConfig | None) -> list[Any]:
    """The objects of a config group that has several, such as `callbacks`."""
    return [build(node) for node in (group or {}).values() if node is not None]
