"""Tasks as jobs of SLURM's arrays, by submitit; all nodes see the same disk.

A job does a chunk of tasks, one after the other. When it ends early (killed, out of memory or time,
its node lost) each of its tasks becomes a job of its own: one that ends its process is found out.
"""

import logging
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import field
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt

from qs3.utils.pool import Maker, Outcome, Outcomes, Result, Task, Tasks, portable
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_STOP_S = 10.0


@settings
class SlurmArrays:
    """Does named tasks in array jobs; see `qs3.utils.pool.Pool`.

    Args:
        folder: for submitit's files; on a disk that all nodes see.
        cluster: "slurm", or "local" for processes of this machine (to try a setting).
        jobs: at most so many run at once.
        tasks_per_job: how many tasks a job has.
        time_limit_min: that a job may take, else it ends early.
        cpus, memory_gb: that a job gets.
        partition, setup: of SLURM, and shell lines before the job; None: none.
        attempts: a task of so many jobs that ended early is given up.
        poll_s: how often jobs are looked at.
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
    attempts: Annotated[int, Ge(2)] = 3
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
        waiting = iter(tasks)
        alone: list[tuple[str, Any]] = []
        deaths: Counter[str] = Counter()
        running: list[tuple[Any, list[tuple[str, Any]]]] = []
        try:
            while True:
                chunks: list[list[tuple[str, Any]]] = []
                while len(running) + len(chunks) < self.jobs:
                    chunk = [alone.pop()] if alone else list(islice(waiting, self.tasks_per_job))
                    if not chunk:
                        break
                    chunks.append(chunk)
                with executor.batch() if chunks else nullcontext():
                    jobs = [executor.submit(_do, make_worker, chunk) for chunk in chunks]
                running += zip(jobs, chunks, strict=True)
                if not running:
                    return
                for one in [one for one in running if one[0].done()]:
                    running.remove(one)
                    job, chunk = one
                    try:
                        results, error = job.result()
                    except submitit.core.utils.UncompletedJobError as early:
                        log.warning("the job of %s ended early: %s", chunk[0][0], early)
                        deaths.update(name for name, _ in chunk)
                        for name, task in chunk:
                            if deaths[name] < self.attempts:
                                alone.append((name, task))
                            else:
                                yield Outcome(name, None, died=True)
                        continue
                    for (name, _), result in zip(chunk, results, strict=False):
                        yield Outcome(name, result)
                    if error is not None:
                        raise error
                if running:
                    time.sleep(self.poll_s)
        finally:
            for job, _ in running:
                with suppress(Exception):  # it has ended by now
                    job.cancel()
            end = time.monotonic() + _STOP_S * (self.cluster == "local")
            while time.monotonic() < end and not all(job.done() for job, _ in running):
                time.sleep(0.1)


def _do(
    make_worker: Callable[[], Any], chunk: Sequence[tuple[str, Any]]
) -> tuple[list[Any], BaseException | None]:
    """A job: the results of its tasks, as far as the first error, and that."""
    # Before the time limit submitit would raise an error within a task, which would pass for a
    # failure of that task. The process ends instead.
    signal.signal(signal.SIGUSR2, signal.SIG_DFL)
    results: list[Any] = []
    try:
        work = make_worker()
        for _, task in chunk:
            results.append(work(task))
    except Exception as error:
        return results, portable(error)
    return results, None
