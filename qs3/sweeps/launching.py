"""What the sweepers have in common: whichever launcher the user chose runs their jobs."""

from __future__ import annotations

from abc import abstractmethod

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from qs3.errors import Qs3Error


class OverLauncher(Sweeper):
    """What our sweepers have in common: whichever launcher the user chose runs the jobs."""

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
        """Called by Hydra; errors meant for the user are shown without a traceback."""
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
