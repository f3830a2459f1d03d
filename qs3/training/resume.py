"""`ckpt_path`: where a run goes on. By itself it goes on from its own last checkpoint, if any."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.errors import MissingDataError
from qs3.runs import folder as runs
from qs3.runs.checkpoints import LAST, check
from qs3.runs.metrics import METRICS
from qs3.training.provenance import compare
from qs3.training.run import Run
from qs3.utils.files import copy_file
from qs3.utils.locks import check_idle

log = logging.getLogger(__name__)

_OF_BEGINNING = ("versions", "threads", "commit", "files")  # of what was trained there
_STAYS = (".hydra", ".lock", "wandb", "pictures", runs.STARTED, METRICS)


def checkpoint_asked_for(run: Run) -> Path | None:
    """The checkpoint that `ckpt_path` names; None where the run has its own, or none is asked for.

    Raises:
        MissingDataError: there is no such checkpoint.
    """
    where = run.cfg.ckpt_path
    own = run.folder / LAST
    if where is None or own.is_file() or int(os.environ.get("LOCAL_RANK", 0)) > 0:
        return None
    path = own if where == "last" else Path(where).expanduser()
    path = path / LAST if path.is_dir() else path
    if path.name != LAST or not path.is_file():
        raise MissingDataError(f"ckpt_path={where}: {path} is not the {LAST} of a run")
    return path


def take_checkpoint(run: Run, started: Mapping[str, Any]) -> dict[str, Any]:
    """Do what `ckpt_path` asks for, before training begins.

    null does nothing. "last" insists on a checkpoint of the run. A path, of a run's folder or of
    the `last.ckpt` in it, brings the same run from elsewhere: another machine's logs, a backup. As
    settings, seed and data must be the same, the result is that of a run that was never moved;
    other versions of torch, or another number of threads, may change it, which is a warning. A run
    that has a checkpoint of its own goes on from that.

    Args:
        run: whose folder it is.
        started: what the run is started with, as in `started.json`.

    Returns:
        What it was begun with, there or here.

    Raises:
        MissingDataError: there is no such checkpoint.
        ConfigError, DataError: it is another run's, was trained on other data, or is damaged.
        Qs3Error: it is still being trained.
    """
    path = checkpoint_asked_for(run)
    if path is None:
        return dict(started)
    other = path.resolve().parent
    begun = runs.read_started(other)
    if begun is None or other.name != run.folder.name:  # named by seed and hash of the settings
        raise MissingDataError(f"ckpt_path={run.cfg.ckpt_path}: not the folder of this run")
    compare(other, begun, started)
    check_idle(other)
    check(path, "copy it again from where it comes from, or leave ckpt_path out to begin anew")
    log.info("going on from %s", path)
    begun = {**started, **{key: begun[key] for key in _OF_BEGINNING if key in begun}}
    runs.write_started(run.folder, begun)
    bring(other, run.folder)
    return begun


def bring(other: Path, folder: Path) -> None:
    """Copy from a run's folder what going on takes: neither logs nor results, pictures or locks.

    The checkpoint comes last: with it a run counts as begun.
    """
    for file in sorted(file for file in other.rglob("*") if file.is_file()):
        part = file.relative_to(other)
        if part.parts[0] not in _STAYS and file.suffix != ".log" and part.name != LAST:
            copy_file(file, folder / part)
    copy_file(other / LAST, folder / LAST)
