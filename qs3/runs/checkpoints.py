"""Checkpoints that survive a kill at any moment: written beside, flushed, then renamed.

They hold weights and plain values only and are read with `weights_only=True`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO
from torch import nn

from qs3.errors import DataError
from qs3.utils.files import atomic_path

LAST = "last.ckpt"


def save(value: Any, path: str | os.PathLike[str]) -> None:
    """Save tensors and plain values to `path`, atomically."""
    with atomic_path(path) as temporary:
        torch.save(value, temporary)


def load(path: str | os.PathLike[str], device: Any = "cpu") -> Any:
    """Read what `save` wrote.

    Raises:
        DataError: the file is missing or damaged.
    """
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        raise DataError(
            f"{path} cannot be read ({type(error).__name__}); start again with force=true"
        ) from error


def copy_weights(net: nn.Module) -> dict[str, torch.Tensor]:
    """The net's parameters and buffers, copied to the CPU."""
    return {name: value.detach().cpu().clone() for name, value in net.state_dict().items()}


class AtomicCheckpointIO(CheckpointIO):
    """Lightning's checkpoints through `save` and `load`."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None
    ) -> None:
        """Write `checkpoint` to `path`."""
        save(checkpoint, path)

    def load_checkpoint(
        self, path: Any, map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read `path`, never a pickle of arbitrary objects."""
        return load(path, "cpu" if map_location is None else map_location)

    def remove_checkpoint(self, path: Any) -> None:
        """Delete `path`."""
        Path(path).unlink(missing_ok=True)


class SaveLast(Checkpoint):
    """Save `last.ckpt` at the end of each epoch.

    Lightning runs callbacks of this kind after all others, so what is saved is the state at the
    boundary between two epochs, and a resume begins with a whole epoch.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save."""
        trainer.save_checkpoint(self.folder / LAST)
