"""What a run notes when it starts, and compares when it goes on."""

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
from omegaconf import DictConfig

from qs3.config import hashing
from qs3.datamodules.fps_cache import remove_old_leftovers
from qs3.errors import ConfigError
from qs3.runs import folder as runs
from qs3.runs.checkpoints import LAST
from qs3.store.store import PointSet
from qs3.training.code import changed_files, code_sha256, files_sha256
from qs3.training.given import Given
from qs3.training.run import Run
from qs3.utils.files import remove_leftovers
from qs3.utils.version import VERSION, commit

log = logging.getLogger(__name__)


def note_start(
    run: Run,
    source: PointSet,
    target: PointSet,
    given: Given | None = None,
    beside_sha256: str = "",
) -> dict[str, Any]:
    """Read `started.json` and compare it with today's data, or write it; `force` begins anew.

    `beside_sha256`: of twins and views that are trained on; "" where there are none.
    """
    weights = {"weights": f"{given.name} {given.sha256}"} if given else {}
    now: dict[str, Any] = {
        "data": {"source": source.sha256, "target": target.sha256},
        **({"beside": beside_sha256} if beside_sha256 else {}),
        "versions": versions() | weights,
        "commit": commit(),
        "code": code_sha256(run.cfg),
        "files": files_sha256(run.cfg),
        "threads": torch.get_num_threads(),
        "config_sha256": hashing.config_sha256(run.cfg),
    }
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:
        first = runs.read_started(run.folder) or {}
        if first.get("config_sha256") != now["config_sha256"]:
            raise ConfigError(
                "the processes of this run have different settings (was a file of conf/ changed "
                "while they started?); start it again"
            )
        return {**now, "threads": first.get("threads")}
    if run.cfg.force:  # not before: without its data an old result would be lost for nothing
        runs.clear(run.folder)
    for folder in (run.folder, *run.folder.glob("round_*")):
        remove_leftovers(folder)
    if run.cfg.data.cache_dir:
        remove_old_leftovers(Path(run.cfg.data.cache_dir))
    started = runs.read_begun(run.folder)
    if started is None:
        runs.write_started(run.folder, now)
        return now
    runs.check_config(run.folder, started.get("config_sha256"), now["config_sha256"])
    for role, dataset in (("source", source), ("target", target)):
        runs.check_data(run.folder, dataset.name, started["data"][role], dataset.sha256)
    beside = started.get("beside", "")
    runs.check_data(run.folder, runs.beside(source.name), beside, beside_sha256)
    runs.check_data(run.folder, WEIGHTS, given_sha256(started), given_sha256(now))
    if not (run.folder / LAST).is_file():  # nothing of it is left to go on with
        runs.write_started(run.folder, now)
        return now
    return started


WEIGHTS = "the classifier that weights= names"


def given_sha256(started: Mapping[str, Any]) -> str:
    """Of the classifier that a run was begun with; "" without one."""
    return started["versions"].get("weights", "").rpartition(" ")[2]


def versions() -> dict[str, str]:
    """Of what decides a result beside settings and data."""
    return {
        "qs3": VERSION,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "lightning": lightning.__version__,
        "numpy": np.__version__,
    }


def is_as_begun(started: Mapping[str, Any], cfg: DictConfig) -> bool:
    """Whether code, versions and torch's threads, which order sums, are those of the start.

    As far as a warm-up goes, in which no selector has a part.
    """
    return not {*_changed(started, cfg)} - {*started.get("files", {})}


def warn_of_changes(started: Mapping[str, Any], cfg: DictConfig) -> None:
    """Say if a run goes on with other code, versions or threads than it was begun with."""
    if changed := _changed(started, cfg):
        log.warning(
            "begun with %s, continued with %s: the result may differ from an uninterrupted run's",
            ", ".join(f"{name} {was}" for name, (was, _) in changed.items()),
            ", ".join(f"{name} {now}" for name, (_, now) in changed.items()),
        )


def _changed(started: Mapping[str, Any], cfg: DictConfig) -> dict[str, tuple[Any, Any]]:
    """What is another than at the start, by name: what it was, what it is."""
    now: dict[str, Any] = versions() | {"threads": torch.get_num_threads()}
    begun = {name: value for name, value in started["versions"].items() if name != "weights"}
    begun["threads"] = started.get("threads") or now["threads"]  # older runs do not say
    now["code"] = code_sha256(cfg)[:12]
    begun["code"] = str(started.get("code", now["code"]))[:12]  # nor this
    if begun["code"] == now["code"]:  # else it has been said
        files = started.get("files", {})
        edited = changed_files(files)
        now |= {name: sha256[:12] for name, sha256 in edited.items()}
        begun |= {name: files[name][:12] for name in edited}
    names = [name for name in {**begun, **now} if begun.get(name) != now.get(name)]
    return {name: (begun.get(name, "none"), now.get(name, "none")) for name in names}
