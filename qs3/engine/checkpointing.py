"""Checkpoints of each epoch, written atomically, read without pickles; and what a run takes."""

import resource
import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO

from qs3.runs.checkpoints import LAST, load, save
from qs3.runs.metrics import Times
from qs3.utils.processor import Moment, processor_seconds


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


class Clock(Callback):
    """Time and memory, counted on from the checkpoint that a run continues.

    What was done between a checkpoint and a kill is done again, and counts once. A warm-up that was
    taken from another run brings its time along.

    Args:
        began: this start, before the data were loaded.
    """

    def __init__(self, began: Moment) -> None:
        self.began = began
        self.before = {"seconds": 0.0, "core_seconds": 0.0, "memory": 0, "gpu": 0}
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()

    def taken(self) -> Times:
        """What the run has taken so far."""
        found = self.state_dict()
        return Times(
            seconds=round(found["seconds"], 1),
            core_seconds=round(found["core_seconds"], 1),
            memory_gb=round(found["memory"] / 1e9, 3) or None,
            gpu_memory_gb=round(found["gpu"] / 1e9, 3) or None,
        )

    def state_dict(self) -> dict[str, Any]:
        """Seconds so far, and bytes at most, in the process and on its GPU."""
        gpu = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
        memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        cores = max(0.0, processor_seconds() - self.began.cores)
        return {
            "seconds": self.before["seconds"] + time.time() - self.began.wall,
            "core_seconds": self.before["core_seconds"] + cores,
            "memory": max(self.before["memory"], memory),
            "gpu": max(self.before["gpu"], gpu),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what earlier starts took."""
        self.before = state_dict
