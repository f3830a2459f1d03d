"""Tasks on several machines: Ray's clusters and SLURM's arrays, in the form of `qs3.utils.pool`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from qs3.config.compose import composed, override
from qs3.config.hydra import build
from qs3.utils.pool import Pool


def pool_of(engine: str, workers: int, settings: Sequence[str], folder: Path) -> Pool:
    """The pool of `conf/engine/<engine>.yaml`, for commands that Hydra does not compose.

    `settings`: such as "engine.address=auto"; `folder`: where an engine may keep its own files.
    """
    words = (f"+engine={engine}", f"+workers={workers}", override("+paths.data_dir", folder))
    pool: Pool = build(composed(None, *words, *settings, place=f"engine={engine}: ").engine)
    return pool
