"""What Hydra needs from us: the run folder as a resolver, instantiation, the multirun summary.

Importing this module registers the resolvers `${qs3.run_name:}` and `${qs3.wandb_id:}`, and for
help texts `${qs3.choices:GROUP}` and `${qs3.described:GROUP}`.
"""

from __future__ import annotations

import atexit
import itertools
import json
import logging
import os
import re
import sys
import tempfile
import textwrap
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
from qs3.errors import ConfigError, Qs3Error

log = logging.getLogger(__name__)


def _run_name(*, _root_: DictConfig) -> str:
    return runs.run_name(_root_)


def _wandb_id(*, _root_: DictConfig) -> str:
    return runs.run_name(_root_).replace("/", "-")


def _choices(group: str, indent: int = 0) -> str:
    """The choices of a config group, as `a | b`; `none` goes without saying.

    With `indent`, in lines of 100 characters that all begin in that column.
    """
    text = " | ".join(path.stem for path in _files(group))
    return ("\n" + " " * indent).join(textwrap.wrap(text, 100 - indent)) if indent else text


def _described(group: str, also: str = "") -> str:
    """A line for each choice of a config group: its name and the first sentence of its file.

    With `also` only the choices that another group has, too.
    """
    files = _files(group)
    if also:
        files = [path for path in files if path.name in {other.name for other in _files(also)}]
    width = max((len(path.stem) for path in files), default=0)
    lines = []
    for path in files:
        head = itertools.takewhile(
            lambda line: line.startswith("#"), path.read_text("utf-8").splitlines()
        )
        words = " ".join(line[1:].strip() for line in head if not line.startswith("# @package"))
        sentence = re.split(r"(?<=[.;])\s", words, maxsplit=1)[0].rstrip(";.")
        short = textwrap.shorten(sentence, 100 - width, placeholder=" ...")
        lines.append(f"  {path.stem:<{width}}  {short}".rstrip())
    return "\n".join(lines)


def _files(group: str) -> list[Path]:
    folder = Path(__file__).resolve().parents[1] / "conf" / group
    return sorted(path for path in folder.glob("*.yaml") if path.stem != "none")


OmegaConf.register_new_resolver("qs3.choices", _choices, replace=True)
OmegaConf.register_new_resolver("qs3.described", _described, replace=True)
OmegaConf.register_new_resolver("qs3.run_name", _run_name, replace=True)
OmegaConf.register_new_resolver("qs3.wandb_id", _wandb_id, replace=True)


def build(node: Any, **more: Any) -> Any:
    """`instantiate` with plain containers, and with our own errors as they were raised.

    Raises:
        ConfigError: the target does not take what stands in the config (a TypeError or ValueError
            of its own); names the place in the config.
    """
    try:
        return instantiate(node, _convert_="all", **more)
    except InstantiationException as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, Qs3Error):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        if isinstance(error.__cause__, TypeError | ValueError):
            place = re.search(r"^full_key: (.+)$", str(error), re.MULTILINE)
            where = place[1] if place else str(error).splitlines()[0]
            raise ConfigError(f"{where}: {error.__cause__}") from error
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

    The list of folders and errors is a file, because jobs may run in other processes (joblib,
    submitit); its name travels to them inside this object.
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
        """Add this job's folder (and say what went wrong: Hydra shows the first error only).

        What all jobs lack, say the data, is said once.
        """
        if self.journal is None:
            return
        error = getattr(job_return, "_return_value", None)
        text = (str(error) or type(error).__name__) if isinstance(error, Exception) else ""
        if text and text not in (entry["error"] for entry in self._entries()):
            log.error("%s failed: %s", " ".join(job_return.overrides), text.splitlines()[0])
        entry = {"folder": str(config.hydra.runtime.output_dir), "error": text}
        with open(self.journal, "a", encoding="utf-8") as file:  # one short write: atomic
            file.write(json.dumps(entry) + "\n")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the summary."""
        self._summarise()

    def _summarise(self) -> None:
        if self.journal is None:
            return
        folders = sorted({Path(entry["folder"]) for entry in self._entries()})
        self.journal.unlink(missing_ok=True)
        self.journal = None
        if any((folder / runs.METRICS).is_file() for folder in folders):
            sys.stdout.write(summarise(folders) + "\n")

    def _entries(self) -> list[dict[str, str]]:
        assert self.journal is not None
        return [json.loads(line) for line in self.journal.read_text(encoding="utf-8").splitlines()]


def summarise(folders: list[Path]) -> str:
    """A small table of the runs in `folders`."""
    from qs3.report.aggregate import summarise as table

    return table(folders)
