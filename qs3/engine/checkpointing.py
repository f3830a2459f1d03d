"""Checkpoints of each epoch, written atomically, read without pickles; and what a run takes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import CheckpointIO

from qs3.errors import DataError
from qs3.runs.checkpoints import LAST, load, save
from qs3.runs.metrics import Times
from qs3.utils.memory import forget_peak, peak_bytes
from qs3.utils.processor_time import Moment, processor_seconds

_LIGHTNINGS = "pytorch-lightning_version"  # what every checkpoint of its trainer has


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
        found = load(path, "cpu" if map_location is None else map_location)
        if not isinstance(found, dict) or _LIGHTNINGS not in found:
            raise DataError(f"{path} holds something else than a run; start again with force=true")
        return found

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
    taken from another run (`qs3.training.shared_warmup`) brings its time along: the sum is what
    the run would have taken alone, up to the speed of the machine.

    Args:
        began: this start, before the data were loaded.
    """

    def __init__(self, began: Moment) -> None:
        self.began = began
        self.before = 0.0
        self.cores_before: float | None = 0.0  # None: a start did not count them
        self.peaks = {"memory": 0, "gpu": 0}
        forget_peak()
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()

    def seconds(self) -> float:
        """Wall time so far."""
        return self.before + time.time() - self.began.wall

    def core_seconds(self) -> float | None:
        """Processor time so far; None if it is not known of an earlier start."""
        if self.cores_before is None:
            return None
        return self.cores_before + max(0.0, processor_seconds() - self.began.cores)

    def taken(self) -> Times:
        """What the run has taken so far."""
        gb = {name: round(peak / 1e9, 3) or None for name, peak in self._now().items()}
        cores = self.core_seconds()
        return Times(
            seconds=round(self.seconds(), 1),
            core_seconds=None if cores is None else round(cores, 1),
            memory_gb=gb["memory"],
            gpu_memory_gb=gb["gpu"],
        )

    def state_dict(self) -> dict[str, Any]:
        """Seconds and bytes so far."""
        return {
            "seconds": self.seconds(),
            "core_seconds": self.core_seconds(),
            "peaks": self._now(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what earlier starts took."""
        self.before = float(state_dict["seconds"])
        self.cores_before = state_dict.get("core_seconds")  # of older versions: none
        self.peaks |= state_dict["peaks"]

    def _now(self) -> dict[str, int]:
        """Bytes at most, in the process and on its GPU; 0 for what is not known."""
        gpu = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
        now = {"memory": peak_bytes() or 0, "gpu": gpu}
        return {name: max(peak, self.peaks[name]) for name, peak in now.items()}
