"""Tasks as jobs of SLURM's arrays, by submitit; all nodes see the same disk.

A job does a chunk of tasks, one after the other, and writes each result to a journal as soon as it
is there. So results come in while a job runs, and when one ends early (killed, out of memory or
time, its node lost) what it had done is kept and it is known which task it had.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt

from qs3.utils.pool import Maker, Outcome, Outcomes, Result, Task, Tasks, portable
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_STOP_S = 10.0
_GRACE_S = 600.0


@settings
class SlurmArrays:
    """Does named tasks in array jobs; see `qs3.utils.pool.Pool`.

    Args:
        folder: for submitit's files and the journals; on a disk that all nodes see.
        cluster: "slurm", or "local" for processes of this machine (to try a setting).
        jobs: at most so many run at once.
        tasks_per_job: how many tasks a job has.
        time_limit_min: that a job may take; what it has not done by then goes to another one.
        cpus, memory_gb: that a job gets.
        partition, setup: of SLURM, and shell lines before the job; None: none.
        attempts: a task during which so many jobs ended is given up.
        poll_s: how often journals are read.
    """

    folder: str
    cluster: Literal["slurm", "local"] = "slurm"
    jobs: Annotated[int, Ge(1)] = 50
    tasks_per_job: Annotated[int, Ge(1)] = 100
    time_limit_min: Annotated[int, Ge(1)] = 240
    cpus: Annotated[int, Ge(1)] = 1
    memory_gb: Annotated[int, Ge(1)] = 4
    partition: str | None = None
    setup: tuple[str, ...] = ()
    attempts: Annotated[int, Ge(1)] = 3
    poll_s: Annotated[float, Gt(0)] = 5.0
    shared_disk: bool = field(default=True, init=False)
    elsewhere: bool = field(default=True, init=False)

    @property
    def at_once(self) -> int:
        """How many tasks are done at the same time."""
        return self.jobs

    def run(self, make_worker: Maker[Task, Result], tasks: Tasks[Task]) -> Outcomes[Result]:
        """Do the tasks; as `qs3.utils.pool.Processes.run`."""
        import submitit

        folder = Path(self.folder).absolute()
        executor = submitit.AutoExecutor(folder=folder, cluster=self.cluster)
        executor.update_parameters(
            name="qs3",
            timeout_min=self.time_limit_min,
            cpus_per_task=self.cpus,
            mem_gb=self.memory_gb,
            slurm_array_parallelism=self.jobs,
            slurm_partition=self.partition,
            slurm_setup=list(self.setup) or None,
        )
        folder.mkdir(parents=True, exist_ok=True)
        waiting = iter(tasks)
        again: list[tuple[str, Any]] = []
        deaths: Counter[str] = Counter()
        running: list[_Job] = []
        try:
            while True:
                chunks: list[list[tuple[str, Any]]] = []
                while len(running) + len(chunks) < self.jobs:
                    # A task that has ended a job is a job of its own: it takes no other one along.
                    chunk = [again.pop()] if again else list(islice(waiting, self.tasks_per_job))
                    if not chunk:
                        break
                    chunks.append(chunk)
                jobs = []
                with executor.batch() if chunks else nullcontext():
                    for chunk in chunks:
                        journal = folder / f"journal-{os.urandom(8).hex()}"
                        handle = executor.submit(_do_chunk, make_worker, chunk, journal)
                        jobs.append(_Job(handle, chunk, journal))
                running += jobs
                if not running:
                    return
                for job in list(running):
                    ended = job.ended(self.time_limit_min * 60 + _GRACE_S)
                    yield from job.new_outcomes()  # after: what it wrote last is there, too
                    if not ended:
                        continue
                    running.remove(job)
                    for file in job.files():
                        file.unlink(missing_ok=True)
                    left = job.unfinished(deaths)
                    waiting = chain([one for one in left if not deaths[one[0]]], waiting)
                    for name, task in (one for one in left if deaths[one[0]]):
                        if deaths[name] < self.attempts:
                            again.append((name, task))
                        else:
                            yield Outcome(name, None, died=True)
                if running:
                    time.sleep(self.poll_s)
        finally:
            _cancel(running, wait_s=_STOP_S if self.cluster == "local" else 0)


@dataclass
class _Job:
    """A job of an array, as this process sees it."""

    handle: Any
    chunk: list[tuple[str, Any]]
    journal: Path
    read: dict[Path, int] = field(default_factory=dict)
    begun: str | None = None
    begun_at: float | None = None
    done: set[str] = field(default_factory=set)

    def files(self) -> list[Path]:
        """Its journal, of each of its starts: SLURM may have begun it anew."""
        return sorted(self.journal.parent.glob(f"{self.journal.name}.*"))

    def ended(self, limit_s: float) -> bool:
        """Whether nothing more will come, at the latest `limit_s` after its first record.

        SLURM may not say so: where no accounting is kept, a killed job runs for ever.
        """
        if self.handle.done():
            return True
        if self.begun_at is None or time.monotonic() - self.begun_at < limit_s:
            return False
        _cancel([self], wait_s=0)
        return True

    def new_outcomes(self) -> Iterator[Outcome[Any]]:
        """What its journal has gained."""
        for name, found in self._records():
            self.begun_at = self.begun_at or time.monotonic()
            if found is None:
                self.begun = name
                continue
            good, value = found
            if not good:
                raise value
            self.begun = None
            if name not in self.done:
                self.done.add(name)
                yield Outcome(name, value)

    def _records(self) -> Iterator[tuple[str, Any]]:
        """New records; one that is still being written is left for the next time."""
        for path in self.files():
            with path.open("rb") as file:
                file.seek(self.read.get(path, 0))
                while True:
                    try:
                        record = pickle.load(file)  # by a job of ours
                    except (EOFError, pickle.UnpicklingError):
                        break
                    self.read[path] = file.tell()
                    yield record

    def unfinished(self, deaths: Counter[str]) -> list[tuple[str, Any]]:
        """What is to be done again; the task during which the job ended is charged for it."""
        left = [(name, task) for name, task in self.chunk if name not in self.done]
        if left:
            guilty = self.begun or left[0][0]  # before its first task: all would end as that one
            deaths[guilty] += 1
            why = None
            with suppress(Exception):
                why = self.handle.exception()
            log.warning("%s: its job ended early (%s)", guilty, why or "no reason is known")
        return left


def _cancel(jobs: list[_Job], wait_s: float) -> None:
    """End jobs; processes of this machine are waited for."""
    for job in jobs:
        with suppress(Exception):  # it has ended by now
            job.handle.cancel()
    end = time.monotonic() + wait_s
    while time.monotonic() < end and not all(job.handle.done() for job in jobs):
        time.sleep(0.1)


def _do_chunk(make_worker: Callable[[], Any], chunk: list[tuple[str, Any]], journal: Path) -> int:
    """A job: its tasks one after the other, each with two records in the journal."""
    # Before the time limit submitit would raise an error within a task, which would pass for a
    # failure of that task. The process ends instead, and the journal says what it had.
    signal.signal(signal.SIGUSR2, signal.SIG_DFL)
    own = journal.with_name(f"{journal.name}.{time.time_ns()}")
    with own.open("xb", buffering=0) as file:

        def note(name: str, found: tuple[bool, Any] | None) -> None:
            file.write(pickle.dumps((name, found)))

        work = None
        for name, task in chunk:
            note(name, None)
            try:
                work = work or make_worker()
                result = work(task)
            except Exception as error:
                note(name, (False, portable(error)))
                return 0
            note(name, (True, result))
    return len(chunk)
