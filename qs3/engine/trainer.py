"""Lightning's trainer as this project uses it."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.utils.allocator import keep_freed_memory

_OURS = ("threads", "gpus", "cuda_graphs", "float32_matmul")


def make_trainer(cfg: DictConfig, **more: Any) -> Trainer:
    """Lightning's trainer by config group `trainer`; `more`: arguments that follow from the run.

    Raises:
        ConfigError: Lightning does not take the settings, or a run cannot have them.
    """
    settings: Any = OmegaConf.to_container(cfg.trainer, resolve=True)
    given = {key: value for key, value in settings.items() if key not in _OURS}
    if isinstance(given.get("profiler"), dict):
        given["profiler"] = build(cfg.trainer.profiler)
    try:
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
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise ConfigError(f"trainer: {error}") from error


def let_weights_rest(trainer: Trainer) -> None:
    """Of several processes (DDP): a step need not use all weights; the others have no gradient.

    As in one process. Without it DDP waits for all, and 0 in place of none would be decayed.
    """
    if isinstance(trainer.strategy, DDPStrategy):
        trainer.strategy._ddp_kwargs["find_unused_parameters"] = True


def build_each(group: DictConfig | None) -> list[Any]:
    """The objects of a config group that has several, such as `callbacks`."""
    return [build(node) for node in (group or {}).values() if node is not None]


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


def quieten() -> None:
    """Leave Lightning's warnings and errors to Hydra's log; drop its tips and adverts."""
    # Lightning 2.6.6 asks torch 2.13 in an old way; not ours to fix.
    warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.setLevel(logging.WARNING)
        logger.propagate = True
