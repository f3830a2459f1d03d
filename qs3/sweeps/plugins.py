"""Plugins of Hydra: a sweeper that runs the jobs of a file, and `hydra/launcher=ray`."""

import json
import logging
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, setup_globals
from hydra.errors import CompactHydraException

from qs3.cluster.ray_tasks import RayTasks
from qs3.errors import Qs3Error

log = logging.getLogger(__name__)

_LOST = JobReturn(
    status=JobStatus.FAILED,
    _return_value=CompactHydraException("the process of a job was killed again and again"),
)


class OverLauncher(BasicSweeper):
    """A sweeper that composes its own jobs; whichever launcher the user chose runs them."""

    def __init__(self) -> None:
        super().__init__(max_batch_size=None)

    def sweep(self, arguments: list[str]) -> list[JobReturn]:
        """Called by Hydra; a `Qs3Error` is shown without a traceback."""
        try:
            return self.run(arguments)
        except Qs3Error as error:
            raise CompactHydraException(f"{type(error).__name__}: {error}") from error

    @abstractmethod
    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Run the sweep, and raise the first error of a job when all are done.

        Args:
            arguments: overrides of the command line, without those of Hydra's own settings.
        """

    def launch(self, jobs: list[list[str]], first: int) -> list[JobReturn]:
        """Run jobs, each a list of overrides; the first has the number `first`."""
        assert self.launcher is not None
        self.validate_batch_is_legal(jobs)
        return list(self.launcher.launch(jobs, initial_job_idx=first))


class ListedJobs(OverLauncher):
    """Runs the jobs in a JSON file: a list of lists of overrides. See `qs3.report.running`.

    Args:
        file: of the jobs.
    """

    def __init__(self, file: str) -> None:
        super().__init__()
        self.file = Path(file)

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Run them all, each with `arguments` as well; then raise the first error, if any."""
        listed: list[list[str]] = json.loads(self.file.read_text("utf-8"))
        jobs = [[*(word for word in arguments if word not in job), *job] for job in listed]
        done = self.launch(jobs, 0)
        for job in done:
            _ = job.return_value  # raises if the job failed
        return done


class RayLauncher(BasicLauncher):
    """Runs jobs as tasks of Ray, each in a process of its own.

    A job whose process is killed, or whose node is lost, begins again, and as runs resume, it goes
    on from its last epoch. Its overrides and results travel; `paths.log_dir` and the data have to
    be on a disk that all nodes see.

    Args:
        jobs: at the same time, on a cluster that is started here.
        settings: of `qs3.cluster.ray_tasks.RayTasks`.
    """

    def __init__(self, jobs: int, **settings: Any) -> None:
        super().__init__()
        # Checked in `launch`: Hydra shows what is raised here as a fault of its own.
        self.settings = {"workers": jobs, "tasks_per_process": 1, **settings}

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run jobs, each a list of overrides, and wait for all; in their order."""
        assert self.config is not None
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        jobs = list(enumerate(map(list, job_overrides), initial_job_idx))
        for number, overrides in jobs:
            log.info("\t#%d : %s", number, " ".join(filter_overrides(overrides)))
        mine = {
            "hydra_context": self.hydra_context,
            "config": self.config,
            "task_function": self.task_function,
        }
        make_worker = partial(_worker, mine, dict(Singleton.get_state()))
        found: dict[int, JobReturn] = {}
        try:
            tasks = ((str(number), (number, overrides)) for number, overrides in jobs)
            for outcome in RayTasks(**self.settings).run(make_worker, tasks):
                found[int(outcome.name)] = outcome.result or _LOST
                log.info("#%s has ended: %d of %d jobs", outcome.name, len(found), len(jobs))
        except (Qs3Error, ValueError) as error:
            raise CompactHydraException(f"{type(error).__name__}: {error}") from error
        return [found[number] for number, _ in jobs]


def _worker(
    launcher: dict[str, Any], singletons: dict[Any, Any]
) -> Callable[[tuple[int, list[str]]], JobReturn]:
    """What runs a job in a process of Ray: Hydra's launcher of one job after the other."""
    setup_globals()
    Singleton.set_state(singletons)
    one = BasicLauncher()
    one.setup(**launcher)
    return lambda job: one.launch([job[1]], initial_job_idx=job[0])[0]
