"""A run is trained: load the data, build net and trainer, fit."""

import logging
import os
import signal
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.engine.checkpointing import AtomicCheckpointIO, Clock, SaveLast
from qs3.engine.classifier import Classifier
from qs3.engine.loggers import EpochRows
from qs3.errors import ConfigError
from qs3.inference.model_file import Result
from qs3.kernels.norms import DomainNorm, check_has_norms
from qs3.methods.base import Method, feature_dims
from qs3.runs.checkpoints import LAST, copy_weights, save
from qs3.selftraining.callback import SelfTraining, WarmupSelection
from qs3.selftraining.released import ReleasedRounds
from qs3.selftraining.student import Student
from qs3.training.load import Loaded, load_data, read_given
from qs3.training.provenance import changed
from qs3.training.run import STUDENT, Run
from qs3.training.shared_warmup import SharedWarmup, warmup_sha256
from qs3.utils.processor import Moment, cores, free_cores, keep_freed_memory, processor_seconds

log = logging.getLogger(__name__)

_OURS = ("threads", "gpus", "cuda_graphs", "float32_matmul")


@dataclass(frozen=True, eq=False)
class Built:
    """The trainer, and the callbacks that evaluation asks afterwards."""

    trainer: Trainer
    classifier: Classifier
    warmup: WarmupSelection
    rounds: SelfTraining
    shared_warmup: SharedWarmup
    clock: Clock


def fit(run: Run) -> tuple[Loaded, Built]:
    """Train a run in its folder, from its last checkpoint on if there is one.

    The saved weights are the same whenever the run is repeated on this machine, interrupted or not.
    """
    began = Moment(time.time(), processor_seconds())
    _quieten()
    trainer = run.cfg.trainer
    threads = free_cores() if trainer.threads == "auto" else trainer.threads or len(cores())
    settle_process(threads, trainer.get("float32_matmul", "highest"))
    method: Method = build(run.cfg.method)
    given = read_given(run.cfg)
    loaded = load_data(run, method, given)
    if trainer.threads == "auto":  # sums are ordered by the threads that the run was begun with
        torch.set_num_threads(loaded.started["threads"])
        log.info("trainer.threads=auto: %d of %d cores", torch.get_num_threads(), len(cores()))
    if found := changed(loaded.started):
        log.warning(
            "begun with %s, continued with %s: the result may differ from an uninterrupted run's",
            ", ".join(f"{name} {was}" for name, (was, _) in found.items()),
            ", ".join(f"{name} {now}" for name, (_, now) in found.items()),
        )
    built = _build(run, method, loaded, given, began)
    _fit(run, loaded, built)
    return loaded, built


def _build(run: Run, method: Method, loaded: Loaded, given: Result | None, began: Moment) -> Built:
    """Everything that `Trainer.fit` needs but the data."""
    cfg, folder, phases = run.cfg, run.folder, run.phases
    classifier = _classifier(run, method, given)
    warmup = WarmupSelection(folder, phases, cfg.selection.teacher)
    of_rounds = ReleasedRounds if run.scheme.released else SelfTraining
    rounds = of_rounds(folder, phases, run.scheme, loaded.evaluation.classes)
    # A warm-up of two versions serves no other run.
    sharing = None if changed(loaded.started) else cfg.paths.warmup_dir
    sha256 = warmup_sha256(cfg, loaded.started)
    shared = SharedWarmup(folder, sharing, sha256, run.seed, phases.warmup)
    clock = Clock(began)
    # In this order: all is done before it is saved.
    callbacks: list[Callback] = [
        *(warmup, rounds, EpochRows(folder, phases), clock),
        *(SaveLast(folder), shared),
    ]
    trainer = _make_trainer(
        cfg,
        max_epochs=phases.total,
        callbacks=[*_build_each(cfg.get("callbacks")), *callbacks],
        logger=_build_each(cfg.get("logger")),
        # In a job of SLURM Lightning would take its tasks, mostly one, for the processes.
        plugins=[AtomicCheckpointIO(), LightningEnvironment()],
        default_root_dir=folder,
    )
    domain_norms = any(isinstance(module, DomainNorm) for module in classifier.net.modules())
    if domain_norms and isinstance(trainer.strategy, DDPStrategy):
        # An epoch may see one of the domains alone: DDP would wait for the other's gradients, and
        # 0 in place of none would be decayed.
        trainer.strategy._ddp_kwargs["find_unused_parameters"] = True
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    for logger in trainer.loggers:
        logger.log_hyperparams(settings)
    return Built(trainer, classifier, warmup, rounds, shared, clock)


def _classifier(run: Run, method: Method, given: Result | None) -> Classifier:
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
        cuda_graphs=cfg.trainer.get("cuda_graphs", True),
    )
    if cfg.evaluation.norms != "trained":
        check_has_norms(classifier.net, cfg.evaluation.norms)
    if scheme.rounds and getattr(scheme.selector, "needs_features", False):
        feature_dims(classifier.net)  # before the warm-up, not after it
    return classifier


def _make_trainer(cfg: DictConfig, **more: Any) -> Trainer:
    """Lightning's trainer by config group `trainer`; `more`: arguments that follow from the run."""
    settings: Any = OmegaConf.to_container(cfg.trainer, resolve=True)
    given = {key: value for key, value in settings.items() if key not in _OURS}
    return Trainer(
        **given,
        **more,
        reload_dataloaders_every_n_epochs=1,  # each epoch has its own order; rounds, their set
        use_distributed_sampler=False,  # `Batches` shares the clouds out itself
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        enable_progress_bar=sys.stderr.isatty(),
        enable_model_summary=False,
    )


def _build_each(group: DictConfig | None) -> list[Any]:
    """The objects of a config group that has several, such as `callbacks`."""
    return [build(node) for node in (group or {}).values() if node is not None]


def _fit(run: Run, loaded: Loaded, built: Built) -> None:
    """One `Trainer.fit` over all phases; what comes after it reads saved weights alone."""
    if not run.cfg.force and int(os.environ.get("LOCAL_RANK", 0)) == 0:
        built.shared_warmup.take()
    last = run.folder / LAST
    log.info("fitting%s, %d epochs", ", continued" * last.is_file(), run.phases.total)
    try:
        built.trainer.fit(
            built.classifier,
            loaded.data,
            ckpt_path=last if last.is_file() else None,
            weights_only=True,
        )
    except SIGTERMException as error:  # of a worker of a sweep; by itself it would be status 0
        raise SystemExit(128 + signal.SIGTERM) from error
    if (done := built.trainer.current_epoch) < run.phases.total:  # `trainer.should_stop`
        raise ConfigError(f"training ended after {done} of {run.phases.total} epochs")
    if built.trainer.is_global_zero:
        save(copy_weights(built.classifier.net), run.folder / STUDENT)
    built.trainer.strategy.barrier("student saved")


def settle_process(threads: int, float32_matmul: str = "highest") -> None:
    """What a training sets for its whole process."""
    keep_freed_memory()
    # With `trainer.deterministic` torch fills each new tensor with NaN, lest one be read unwritten.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(float32_matmul)


def _quieten() -> None:
    """Leave Lightning's warnings and errors to Hydra's log; drop its tips and adverts."""
    # Lightning 2.6.6 asks torch 2.13 in an old way; not ours to fix.
    warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.setLevel(logging.WARNING)
        logger.propagate = True
