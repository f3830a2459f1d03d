"""A sweeper that runs the jobs of a file, for tables; and what all our sweepers share."""

from __future__ import annotations

import json
from abc import abstractmethod
from pathlib import Path

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from qs3.errors import Qs3Error


class OverLauncher(Sweeper):
    """A sweeper whose jobs are run by whichever launcher the user chose."""

    hydra_context: HydraContext
    config: DictConfig
    launcher: Launcher

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Called by Hydra before `sweep`."""
        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

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
        self.validate_batch_is_legal(jobs)
        return list(self.launcher.launch(jobs, initial_job_idx=first))


class ListedJobs(OverLauncher):
    """Runs the jobs in a JSON file: a list of lists of overrides. See `qs3.report.tables`.

    Args:
        file: of the jobs.
        at_once: so many are handed to the launcher, and waited for, before the next; None: all.
    """

    def __init__(self, file: str, at_once: int | None = None) -> None:
        self.file, self.at_once = Path(file), at_once

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Run them all, each with `arguments` as well; then raise the first error, if any."""
        listed: list[list[str]] = json.loads(self.file.read_text("utf-8"))
        step = self.at_once or max(1, len(listed))
        done: list[JobReturn] = []
        for first in range(0, len(listed), step):
            jobs = [
                [*(word for word in arguments if word not in job), *job]
                for job in listed[first : first + step]
            ]
            done += self.launch(jobs, first)
        for job in done:
            _ = job.return_value  # raises if the job failed
        return done
