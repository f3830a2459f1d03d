"""`ckpt_path`: where a run goes on. By itself it goes on from its own last checkpoint, if any."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, MissingDataError
from qs3.runs import folder as runs
from qs3.runs.checkpoints import LAST, check
from qs3.runs.metrics import METRICS
from qs3.training.provenance import WEIGHTS, given_sha256
from qs3.training.run import Run
from qs3.utils.files import copy_file
from qs3.utils.locks import check_idle

log = logging.getLogger(__name__)

_LAST = "last"
_ROLES = ("source", "target")
_OF_BEGINNING = ("versions", "threads", "commit", "code", "files")  # of what was trained there
_STAYS = (".hydra", ".lock", "wandb", "pictures", runs.STARTED, METRICS)
_INSTEAD = "or leave ckpt_path out to begin anew"


def checkpoint_asked_for(run: Run) -> Path | None:
    """The checkpoint that `ckpt_path` names; None where the run has its own, or none is asked for.

    Raises:
        MissingDataError: there is no such checkpoint.
    """
    where = run.cfg.ckpt_path
    own = run.folder / LAST
    if where is None or own.is_file() or int(os.environ.get("LOCAL_RANK", 0)) > 0:
        return None
    if where == _LAST:
        raise MissingDataError(
            f"ckpt_path={_LAST}, but {own} is not there: a run with these settings and seed has "
            "not begun, or was not an epoch old; leave ckpt_path out to begin it"
        )
    path = Path(where).expanduser()
    path = path / LAST if path.is_dir() else path
    if path.name != LAST or not path.is_file():
        raise MissingDataError(
            f"ckpt_path={where}: no {LAST} of a run is there; name a run's folder or the {LAST} in "
            "it (qs3 predict uses finished runs)"
        )
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
        ConfigError: it is another run's.
        DataError: it was trained on other data, or is damaged.
        Qs3Error: it is still being trained.
    """
    path = checkpoint_asked_for(run)
    if path is None:
        return dict(started)
    where = run.cfg.ckpt_path
    other = path.resolve().parent
    begun = runs.read_begun(other)
    if begun is None:
        raise MissingDataError(
            f"ckpt_path={where}: there is no {runs.STARTED} beside {LAST}, which says what the run "
            "was begun with; bring its whole folder, or leave ckpt_path out to begin anew"
        )
    if other.name != run.folder.name:
        raise ConfigError(
            f"ckpt_path={where} belongs to another run: its folder is {other.name}, this one's "
            f"{run.folder.name} (seed and hash of the settings). Give the command that began it, "
            "or leave ckpt_path out"
        )
    runs.check_config(other, begun.get("config_sha256"), started["config_sha256"], _INSTEAD)
    check_idle(other)
    for name, was, now in (
        *((f"data.{role}", begun["data"][role], started["data"][role]) for role in _ROLES),
        (runs.beside("data.source"), *(one.get("beside", "") for one in (begun, started))),
        (WEIGHTS, *map(given_sha256, (begun, started))),
    ):
        runs.check_data(other, name, was, now, _INSTEAD)
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
