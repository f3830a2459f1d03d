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

from qs3.config import hashing
from qs3.data.store import PointSet
from qs3.datamodules.fps_cache import remove_old_leftovers
from qs3.errors import ConfigError
from qs3.runs import folder as runs
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
    """Read `started.json` and compare it with today's data, or write it.

    `beside_sha256`: of twins and views that are trained on; "" where there are none.
    """
    now: dict[str, Any] = {
        "data": {"source": source.sha256, "target": target.sha256},
        **({"beside": beside_sha256} if beside_sha256 else {}),
        "versions": {
            "qs3": VERSION,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": lightning.__version__,
            "numpy": np.__version__,
            **({"weights": f"{given.name} {given.sha256}"} if given else {}),
        },
        "commit": commit(),
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
    for folder in (run.folder, *run.folder.glob("round_*")):
        remove_leftovers(folder)
    if run.cfg.data.cache_dir:
        remove_old_leftovers(Path(run.cfg.data.cache_dir))
    started = runs.read_started(run.folder)
    if started is None:
        runs.write_started(run.folder, now)
        return now
    runs.check_config(run.folder, started.get("config_sha256"), now["config_sha256"])
    for role, dataset in (("source", source), ("target", target)):
        runs.check_data(run.folder, dataset.name, started["data"][role], dataset.sha256)
    name = f"what lies beside {source.name}"
    runs.check_data(run.folder, name, started.get("beside", ""), beside_sha256)
    warn_of_versions(started["versions"], now["versions"])
    return started


def warn_of_versions(begun: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Say if a run goes on with other versions than it was begun with."""
    if begun != now:
        log.warning(
            "begun with %s, continued with %s: the result may differ from an uninterrupted run's",
            begun,
            now,
        )
