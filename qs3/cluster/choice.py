"""A pool by the name of its engine, for commands that Hydra does not compose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from qs3.config.compose import choices, composed
from qs3.config.hydra import build
from qs3.config.quoting import override
from qs3.utils.pool import Pool


def engines() -> list[str]:
    """The names of `conf/engine`."""
    return choices("engine")


def pool_of(engine: str, workers: int, settings: Sequence[str], folder: Path) -> Pool:
    """The pool of `conf/engine/<engine>.yaml`.

    Args:
        engine: its name.
        workers: processes of this machine.
        settings: such as "engine.address=auto".
        folder: where an engine may keep its own files.

    Raises:
        ConfigError: no such engine or setting.
    """
    words = (f"+engine={engine}", f"+workers={workers}", override("+paths.data_dir", folder))
    pool: Pool = build(composed(None, *words, *settings, place=f"engine={engine}: ").engine)
    return pool
