"""What a multirun prints at its end: mean and SEM over seeds, every job that failed.

With `objective=`, by which the runs of a grid or a search are compared without labels, it prints
the objective of each instead of accuracies, and refuses beforehand to vary how runs are judged.
"""

import atexit
import concurrent.futures.thread  # noqa: F401  pandas needs it, too late at exit: see `_summarise`
import json
import logging
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import CompactHydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from qs3.errors import ConfigError
from qs3.runs.metrics import METRICS
from qs3.sweeps.search import Tried, check_varied, register, report, split
from qs3.utils.files import make_folder

log = logging.getLogger(__name__)

_NO_END = "did not end: killed, interrupted or still running; the same command goes on with it"


class SummaryOfSeeds(Callback):
    """After a multirun: mean and SEM over the seeds of each config, or objectives; what failed.

    Jobs may run in other processes and on other machines (joblib, submitit), so what becomes of
    them is noted in a file next to the runs; its name travels to the jobs inside this object.
    `table`: whether finished runs are summarised; a search has a table of its own.
    """

    def __init__(self, table: bool = True) -> None:
        self.table = table
        self.journal: Path | None = None
        self._main = 0
        self.objective: str | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Begin a new list; leave if an objective could not compare the runs."""
        register()
        self.objective = config.get("objective")
        if self.objective is not None:
            params = config.hydra.sweeper.get("params") or {}
            try:
                check_varied(split(config.hydra.overrides.task, params)[1].values())
            except ConfigError as error:  # Hydra makes a warning of a callback's exception
                raise SystemExit(f"{type(error).__name__}: {error}") from error
        self._main = os.getpid()
        folder = make_folder(Path(config.hydra.sweep.dir).resolve())
        handle, name = tempfile.mkstemp(prefix=".multirun-", suffix=".txt", dir=folder)
        os.close(handle)
        self.journal = Path(name)
        # Hydra leaves a sweep by the first failed job's exception, past `on_multirun_end`; the
        # finished seeds are worth a table nevertheless.
        atexit.register(self._summarise)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note that the job has begun: a job that is killed notes nothing later."""
        # As they were given, which is how a job's end names them; `${...}` would be resolved.
        task = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
        self._note(config, overrides=task)

    def on_job_end(self, config: DictConfig, job_return: Any, **kwargs: Any) -> None:
        """Note how the job has ended, and log what went wrong: Hydra shows the first error only."""
        if self.journal is None:
            return
        returned, text = getattr(job_return, "_return_value", None), ""
        if isinstance(returned, Exception):
            text = str(returned).strip().partition("\n")[0]
            if not isinstance(returned, CompactHydraException):  # whose text begins with the kind
                text = f"{type(returned).__name__}: {text}"
        if text and text not in (entry.get("error") for entry in self._read()):
            log.error("%s failed: %s", " ".join(job_return.overrides), text)
        value = returned if isinstance(returned, float) else None
        self._note(config, overrides=list(job_return.overrides), error=text, value=value)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the summary."""
        self._summarise()

    def _note(self, config: DictConfig, **more: Any) -> None:
        if self.journal is None:
            return
        hydra = config.hydra
        entry = {"folder": str(hydra.runtime.output_dir), "job": hydra.job.get("num", 0), **more}
        try:  # never made here: a job that ends after the summary leaves nothing behind
            handle = os.open(self.journal, os.O_WRONLY | os.O_APPEND)
        except FileNotFoundError:
            return
        with open(handle, "wb") as file:  # one short write: atomic, save on a network's disk
            file.write((json.dumps(entry) + "\n").encode())

    def _summarise(self) -> None:
        if self.journal is None or os.getpid() != self._main:
            return
        last = {(entry["folder"], *entry["overrides"]): entry for entry in self._read()}
        jobs = sorted(last.values(), key=lambda job: job["job"])
        self.journal.unlink(missing_ok=True)
        self.journal = None
        folders = list(dict.fromkeys(Path(job["folder"]) for job in jobs))
        if self.table and self.objective is not None and jobs:
            sys.stdout.write(objectives(jobs, self.objective) + "\n")
        elif self.table and any((folder / METRICS).is_file() for folder in folders):
            from qs3.report.results import summarise

            sys.stdout.write(summarise(folders, differences(jobs)) + "\n")
        sys.stdout.write(failures(jobs))
        sys.stdout.flush()

    def _read(self) -> list[dict[str, Any]]:
        assert self.journal is not None
        try:
            return [json.loads(line) for line in self.journal.read_text("utf-8").splitlines()]
        except FileNotFoundError:  # by a job that ends after the summary
            return []


def failures(jobs: Sequence[Mapping[str, Any]]) -> str:
    """The jobs that failed, by error: "" if a job went well, and missing if it never ended."""
    by_error: dict[str, list[str]] = {}
    for job in jobs:
        if job.get("error") != "":
            line = f"    {' '.join(job['overrides'])}  ({job['folder']})"
            by_error.setdefault(job.get("error", _NO_END), []).append(line)
    if not by_error:
        return ""
    lines = [f"{sum(map(len, by_error.values()))} of {len(jobs)} jobs failed:"]
    for error, members in by_error.items():
        lines += [f"  {error}", *sorted(members)]
    return "\n".join(lines) + "\n"


def differences(jobs: Sequence[Mapping[str, Any]]) -> dict[Path, str]:
    """By folder the overrides in which jobs differ, without the seed; "" if they do not."""
    words, keys = _varied(jobs)
    several = [key for key in keys if key != "seed"]
    return {
        Path(job["folder"]): " ".join(f"{key}={one[key]}" for key in several if key in one)
        for job, one in zip(jobs, words, strict=True)
    }


def objectives(jobs: Sequence[Mapping[str, Any]], name: str) -> str:
    """A table of the runs' objectives (each job's "value") and the best of them; no accuracy."""
    words, keys = _varied(jobs)
    tried = [
        Tried(
            job["job"],
            {key: one[key] for key in keys},
            job.get("value"),
            "/".join(Path(job["folder"]).parts[-2:]),
        )
        for job, one in zip(jobs, words, strict=True)
    ]
    fixed = [word for word in jobs[0]["overrides"] if word.partition("=")[0] not in keys]
    return report(f"{name}, which needs no labels, of each run", name, tried, fixed)


def _varied(jobs: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, str]], list[str]]:
    """Each job's overrides by key, and the keys in which they differ."""
    words = [dict(word.partition("=")[::2] for word in job["overrides"]) for job in jobs]
    keys = dict.fromkeys(key for one in words for key in one)
    return words, [key for key in keys if len({one.get(key) for one in words}) > 1]
