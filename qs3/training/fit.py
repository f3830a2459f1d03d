"""The training story: load the data, build net and trainer, fit, evaluate, write.

Each stage is a module of its own; what one hands to the next is a dataclass.
"""

from __future__ import annotations

import logging
import os
import signal
import time
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException

from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.methods.base import Method
from qs3.models.features import remember
from qs3.runs.checkpoints import LAST, copy_weights, save
from qs3.runs.metrics import RunMetrics
from qs3.training.build import Built, build_training
from qs3.training.evaluate import evaluate
from qs3.training.given import read_given
from qs3.training.load import Loaded, load_data
from qs3.training.provenance import warn_of_changes
from qs3.training.resume import take_checkpoint
from qs3.training.run import STUDENT, Run
from qs3.training.write import write_outcome
from qs3.utils.processor import Moment, cores, keep_freed_memory, number_of, processor_seconds

log = logging.getLogger(__name__)


def fit(run: Run) -> RunMetrics:
    """Train a run in its folder, from its last checkpoint on if there is one.

    Returns:
        What `metrics.json` is to hold: the same whenever the run is repeated on this machine,
        interrupted or not, except its times.
    """
    began = Moment(time.time(), processor_seconds())
    _quieten()
    trainer = run.cfg.trainer
    settle_process(number_of(trainer.threads), trainer.get("float32_matmul", "highest"))
    method: Method = build(run.cfg.method)
    given = read_given(run.cfg)
    loaded = load_data(run, method, given)
    if not run.cfg.force:
        loaded = replace(loaded, started=take_checkpoint(run, loaded.started))
    if trainer.threads == "auto":  # sums are ordered by the threads that the run was begun with
        torch.set_num_threads(loaded.started["threads"])
        log.info("trainer.threads=auto: %d of %d cores", torch.get_num_threads(), len(cores()))
    warn_of_changes(loaded.started)
    built = build_training(run, method, loaded, given, began)
    _fit(run, loaded, built)
    outcome = evaluate(run, loaded, built)
    return write_outcome(run, loaded, built, outcome)


def _fit(run: Run, loaded: Loaded, built: Built) -> None:
    """One `Trainer.fit` over all phases.

    A checkpoint lies between two epochs; a resume repeats an epoch. What comes after it reads saved
    weights alone, so it is the same after any interruption.

    Raises:
        ConfigError: a callback has ended the training.
    """
    data, kept = loaded.data, run.cfg.data.cache_dir
    clouds = (data.all_labelled, data.target, loaded.evaluation.test)
    remember(built.classifier.net, clouds, Path(kept) if kept else None)
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
    """What a training sets for its whole process: memory is kept, no tensor is filled in vain.

    Args:
        threads: of torch.
        float32_matmul: see `torch.set_float32_matmul_precision`.
    """
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
