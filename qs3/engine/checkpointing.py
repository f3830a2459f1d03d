"""Lightning's checkpoints at the end of each epoch, written atomically, read without pickles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO

from qs3.runs.checkpoints import LAST, load, save


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
