"""Warm-ups are trained once: runs that differ only in what follows go on from one checkpoint.

When a run is one epoch away from the end of its warm-up, its checkpoint is copied to

    <paths.warmup_dir>/<hash>-seed<seed>/last.ckpt, history.csv, started.json

The hash covers everything that the warm-up depends on, datasets, versions and code included. A run
of the same hash begins from that copy as if it had been interrupted there: it trains the last
epoch itself, so teacher, pseudo-labels and result are the same, to the bit, as without it.
`started.json` is written last and has the hashes of the other two: a copy that has changed since is
replaced. Who copies holds a lock there, which ends with its process: of runs that started together
the first gives its warm-up, and who comes meanwhile waits for whole files.
"""

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import config_sha256, with_values
from qs3.engine.loggers import HISTORY
from qs3.errors import DataError
from qs3.runs import folder as runs
from qs3.runs.checkpoints import LAST
from qs3.utils.files import copy_file, locked, remove_leftovers, sha256_file, write_json

log = logging.getLogger(__name__)

_FILES = (HISTORY, LAST)
# Not `selection`: the checkpoint holds the teacher chosen so far.
_AFTERWARDS = ("selftraining", "evaluation", "experiment_name")


def warmup_sha256(cfg: DictConfig, started: Mapping[str, Any]) -> str:
    """64 hex digits over what a warm-up depends on (also `started.json`), except its seed."""
    before = OmegaConf.create(with_values(cfg, _AFTERWARDS))
    for key in _AFTERWARDS:
        OmegaConf.update(before, key, None)
    parts = [config_sha256(before), started["data"], started["versions"]]
    parts += [started["threads"], started["files"]]  # sums are ordered by threads
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class SharedWarmup(Checkpoint):
    """Gives a run's warm-up to others, and takes theirs; behind `SaveLast` among the callbacks.

    `shared`: `paths.warmup_dir`, None shares nothing; `warmup`: epochs of the warm-up, of a single
    one nothing is worth sharing.
    """

    def __init__(
        self, folder: Path, shared: str | Path | None, sha256: str, seed: int, warmup: int
    ) -> None:
        self.folder, self.sha256, self.last_but_one = folder, sha256, warmup - 2
        self.shared = None if shared is None else Path(shared) / f"{sha256[:8]}-seed{seed}"

    def take(self) -> bool:
        """Begin from a shared warm-up, if there is one and the run has no checkpoint yet."""
        if self.shared is None or not self.shared.is_dir() or (self.folder / LAST).exists():
            return False
        with self._alone():
            if not self._is_there():
                if (self.shared / runs.STARTED).exists():
                    log.warning("the warm-up in %s is damaged: it is trained again", self.shared)
                return False
            log.info("the warm-up was trained before: going on from %s", self.shared)
            for name in _FILES:  # the checkpoint last: with it a run counts as begun
                copy_file(self.shared / name, self.folder / name)
        return True

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Copy the checkpoint that has just been written, one epoch before the warm-up's end."""
        if trainer.current_epoch != self.last_but_one or not trainer.is_global_zero:
            return
        if self.shared is None:
            return
        try:
            with self._alone():
                if self._is_there():
                    return
                (self.shared / runs.STARTED).unlink(missing_ok=True)
                remove_leftovers(self.shared)  # of a copy that was killed
                for name in _FILES:
                    copy_file(self.folder / name, self.shared / name)
                write_json(self.shared / runs.STARTED, _mark(self.sha256, self.folder))
        except Exception as error:  # a full disk, say: sharing is a convenience
            log.warning("the warm-up cannot be shared (%s); training goes on", error)

    def _alone(self) -> AbstractContextManager[None]:
        """Wait until no other run copies there, as far as a lock can say: it needs a file."""
        assert self.shared is not None
        writable = not self.shared.exists() or os.access(self.shared, os.W_OK)
        return locked(self.shared / ".lock") if writable else nullcontext()

    def _is_there(self) -> bool:
        """Whether a complete one of this hash lies there, as it was written."""
        assert self.shared is not None
        try:
            mark = runs.read_started(self.shared)
            return mark == _mark(self.sha256, self.shared) if mark else False
        except (DataError, OSError):  # damaged: as good as not there
            return False


def _mark(sha256: str, folder: Path) -> dict[str, Any]:
    """What says that the files in a folder are the warm-up of this hash."""
    files = {name: sha256_file(folder / name) for name in _FILES}
    return {"warmup_sha256": sha256, "files": files}
