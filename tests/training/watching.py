"""Callbacks that look on: put at `callbacks.progress`, which no hash covers, in real processes."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback
from omegaconf import open_dict

from qs3.config.hydra import config_hash
from qs3.runs.checkpoints import copy_weights, save
from qs3.training.command import train


class Watch(Callback):
    """Writes what each process trains on, and its weights: `<folder>/<epoch>-<process>.pt`.

    A file holds "clouds" (by domain: positions in the training split, in the order in which they
    came; found by their coordinates, so augmentation must be off), "selection" (indices and labels
    as the process holds them) and "weights" at the end of the epoch.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.seen: dict[str, list[int]] = {}

    def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
        self.seen = {"source": [], "target": []}

    def on_train_batch_start(
        self, trainer: Any, pl_module: Any, batch: dict[str, Any], batch_idx: int
    ) -> None:
        data = trainer.datamodule
        for domain, clouds in (("source", data.labelled.clouds), ("target", data.target)):
            if domain in batch:
                same = (batch[domain]["points"][:, None] == clouds.points[None]).all(dim=(2, 3))
                assert (same.sum(1) == 1).all()
                self.seen[domain] += same.int().argmax(1).tolist()

    def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        """Before the rounds' callback selects: what this epoch was trained on."""
        file = self.folder / f"{trainer.current_epoch}-{trainer.global_rank}.pt"
        index, labels = trainer.datamodule.pseudo or (None, None)
        save(
            {
                "clouds": self.seen,
                "selection": {"index": index, "labels": labels},
                "weights": copy_weights(pl_module.net),
            },
            file,
        )


class WatchWeights(Callback):
    """Writes all that a process holds at an epoch's end, the method's too, as `Watch` does."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        """Before the rounds' callback selects."""
        file = self.folder / f"{trainer.current_epoch}-{trainer.global_rank}.pt"
        save({"weights": copy_weights(pl_module)}, file)


class Keep(Callback):
    """Copies each epoch's checkpoint to `<folder>/<epoch>.ckpt`, before the next one begins.

    Beside it, in `<folder>/<epoch>-<batch>.pt`: weights, optimiser and rates before each batch.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def _copy(self, trainer: Any, epoch: int) -> None:
        last = Path(trainer.default_root_dir) / "last.ckpt"
        if last.is_file():
            shutil.copy(last, self.folder / f"{epoch}.ckpt")

    def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
        self._copy(trainer, trainer.current_epoch - 1)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self._copy(trainer, trainer.max_epochs - 1)

    def on_train_batch_start(
        self, trainer: Any, pl_module: Any, batch: dict[str, Any], batch_idx: int
    ) -> None:
        (optimizer,) = trainer.optimizers
        save(
            {
                "weights": copy_weights(pl_module.net),
                "moments": len(optimizer.state),
                "rates": [group["lr"] for group in optimizer.param_groups],
            },
            self.folder / f"{trainer.current_epoch}-{batch_idx}.pt",
        )


class KillAt(Callback):
    """Kills its process, as a power cut does, after a batch of an epoch."""

    def __init__(self, epoch: int, batch: int) -> None:
        self.epoch, self.batch = epoch, batch

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if (trainer.current_epoch, batch_idx) == (self.epoch, self.batch):
            os.kill(os.getpid(), signal.SIGKILL)


def seen_by(folder: Path, epoch: int, processes: int = 2) -> list[dict[str, Any]]:
    """What `Watch` wrote of an epoch, by process."""
    return [
        torch.load(folder / f"{epoch}-{rank}.pt", weights_only=True) for rank in range(processes)
    ]


class Stop(Exception):
    """Stands for a kill."""


class StopAt(Callback):
    """Raises in one hook, the n-th time; or the n-th time in an epoch."""

    def __init__(self, hook: str, count: int = 1, epoch: int | None = None) -> None:
        self.left = count

        def stop(trainer: Any, *args: Any, **kwargs: Any) -> None:
            self.left -= epoch in (None, trainer.current_epoch)
            if self.left == 0:
                raise Stop

        setattr(self, hook, stop)

    # Lightning looks hooks up by name; these are replaced on the instance.
    def on_train_batch_end(self, *args: Any, **kwargs: Any) -> None: ...
    def on_train_epoch_start(self, *args: Any, **kwargs: Any) -> None: ...
    def on_train_epoch_end(self, *args: Any, **kwargs: Any) -> None: ...
    def on_validation_batch_end(self, *args: Any, **kwargs: Any) -> None: ...
    def on_train_start(self, *args: Any, **kwargs: Any) -> None: ...
    def on_train_end(self, *args: Any, **kwargs: Any) -> None: ...


def interrupt(
    cfg: Any, hook: str = "on_train_batch_end", count: int = 1, epoch: int | None = None
) -> None:
    """Train until `StopAt` raises; without a hook in the middle of an epoch."""
    stopping = cfg.copy()
    with open_dict(stopping):
        stopping.callbacks.progress = {
            "_target_": "tests.training.watching.StopAt",
            "hook": hook,
            "count": count,
            "epoch": epoch,
        }
    assert config_hash(stopping) == config_hash(cfg)
    with pytest.raises(Stop):
        train(stopping)
