"""What a run notes when it starts, and compares when it goes on: data, versions, code, threads."""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch

from qs3.config import hashing
from qs3.datamodules.fps_samples import remove_old_leftovers
from qs3.runs import folder as runs
from qs3.runs.checkpoints import LAST
from qs3.store.store import PointSet
from qs3.training.given import Given
from qs3.training.reuse import changed_files, files_sha256
from qs3.training.run import Run
from qs3.utils.files import remove_leftovers
from qs3.utils.version import VERSION, commit

log = logging.getLogger(__name__)

WEIGHTS = "the classifier that weights= names"


def note_start(
    run: Run, source: PointSet, target: PointSet, given: Given | None = None
) -> dict[str, Any]:
    """Read `started.json` and compare it with today's data, or write it; `force` begins anew."""
    weights = {"weights": f"{given.name} {given.sha256}"} if given else {}
    now: dict[str, Any] = {
        "data": {"source": source.sha256, "target": target.sha256},
        "versions": versions() | weights,
        "commit": commit(),
        "files": files_sha256(run.cfg),
        "threads": torch.get_num_threads(),
        "config_sha256": hashing.config_sha256(run.cfg),
    }
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        first = runs.read_started(run.folder) or {}
        assert first.get("config_sha256") == now["config_sha256"], "conf/ changed during the start"
        return {**now, "threads": first.get("threads")}
    if run.cfg.force:  # not before: without its data an old result would be lost for nothing
        runs.clear(run.folder)
    for folder in (run.folder, *run.folder.glob("round_*")):
        remove_leftovers(folder)
    if run.cfg.data.cache_dir:
        remove_old_leftovers(Path(run.cfg.data.cache_dir))
    started = runs.read_started(run.folder)
    if started is not None:
        compare(run.folder, started, now)
        if (run.folder / LAST).is_file():
            return started
    runs.write_started(run.folder, now)
    return now


def compare(folder: Path, started: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to continue the run in a folder with other settings, data or another classifier.

    Raises:
        ConfigError, DataError: something differs.
    """
    runs.check_config(folder, started.get("config_sha256"), now["config_sha256"])
    for role in ("source", "target"):
        runs.check_data(folder, f"data.{role}", started["data"][role], now["data"][role])
    runs.check_data(folder, WEIGHTS, given_sha256(started), given_sha256(now))


def given_sha256(started: Mapping[str, Any]) -> str:
    """Of the classifier that a run was begun with; "" without one."""
    return started["versions"].get("weights", "").rpartition(" ")[2]


def versions() -> dict[str, str]:
    """Of what decides a result besides settings and data."""
    return {
        "qs3": VERSION,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "lightning": lightning.__version__,
        "numpy": np.__version__,
    }


def changed(started: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """What differs from the start by name, as it was and as it is: code, versions, threads."""
    now: dict[str, Any] = versions() | {"threads": torch.get_num_threads()}
    begun = {name: value for name, value in started["versions"].items() if name != "weights"}
    begun["threads"] = started.get("threads")
    for name, sha256 in changed_files(started["files"]).items():
        begun[name], now[name] = started["files"][name][:12], sha256[:12]
    names = [name for name in {**begun, **now} if begun.get(name) != now.get(name)]
    return {name: (begun.get(name), now.get(name)) for name in names}


def warn_of_changes(started: Mapping[str, Any]) -> None:
    """Warn if a run goes on with other code, versions or threads than it was begun with."""
    if found := changed(started):
        log.warning(
            "begun with %s, continued with %s: the result may differ from an uninterrupted run's",
            ", ".join(f"{name} {was}" for name, (was, _) in found.items()),
            ", ".join(f"{name} {now}" for name, (_, now) in found.items()),
        )
