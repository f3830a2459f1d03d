"""What Hydra needs from us: the run folder as a resolver, instantiation, the multirun summary.

Importing this module registers the resolvers `${qs3.run_name:}` and `${qs3.wandb_id:}`.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from qs3 import runs
from qs3.errors import Qs3Error

log = logging.getLogger(__name__)


def _run_name(*, _root_: DictConfig) -> str:
    return runs.run_name(_root_)


def _wandb_id(*, _root_: DictConfig) -> str:
    return runs.run_name(_root_).replace("/", "-")


OmegaConf.register_new_resolver("qs3.run_name", _run_name, replace=True)
OmegaConf.register_new_resolver("qs3.wandb_id", _wandb_id, replace=True)


def build(node: Any, **more: Any) -> Any:
    """`instantiate` with plain containers, and with our own errors as they were raised."""
    try:
        return instantiate(node, _convert_="all", **more)
    except InstantiationException as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, Qs3Error):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        raise


def speak_plainly(task: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    """Run `task`; an error meant for the user becomes a message without a traceback.

    HYDRA_FULL_ERROR=1 shows the traceback nevertheless.
    """
    try:
        return task(cfg)
    except Qs3Error as error:
        raise CompactHydraException(f"{type(error).__name__}: {error}") from error


def in_multirun() -> bool:
    """Whether this job is one of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


class SummaryOfSeeds(Callback):
    """After a multirun: mean and SEM over the seeds of each config.

    The list of folders is a file, because jobs may run in other processes (joblib, submitit);
    its name travels to them inside this object.
    """

    def __init__(self) -> None:
        self.journal: Path | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Begin a new list."""
        handle, name = tempfile.mkstemp(prefix="qs3-multirun-", suffix=".txt")
        os.close(handle)
        self.journal = Path(name)
        # Hydra leaves a sweep by the first failed job's exception, past `on_multirun_end`; the
        # finished seeds are worth a table nevertheless.
        atexit.register(self._summarise)

    def on_job_end(self, config: DictConfig, job_return: Any, **kwargs: Any) -> None:
        """Add this job's folder (and say what went wrong: Hydra shows the first error only)."""
        if self.journal is None:
            return
        error = getattr(job_return, "_return_value", None)
        if isinstance(error, Exception):
            log.error("%s failed: %s", " ".join(job_return.overrides), str(error).splitlines()[0])
        with open(self.journal, "a", encoding="utf-8") as file:  # one short write: atomic
            file.write(f"{config.hydra.runtime.output_dir}\n")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the summary."""
        self._summarise()

    def _summarise(self) -> None:
        if self.journal is None:
            return
        folders = [Path(line) for line in self.journal.read_text(encoding="utf-8").splitlines()]
        self.journal.unlink(missing_ok=True)
        self.journal = None
        if folders:
            sys.stdout.write(summarise(sorted(set(folders))) + "\n")


def summarise(folders: list[Path]) -> str:
    """A small table of the runs in `folders`."""
    from qs3.report.aggregate import summarise as table

    return table(folders)
