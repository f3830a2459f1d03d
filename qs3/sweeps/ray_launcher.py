"""`hydra/launcher=ray`: the jobs of a sweep as tasks of Ray, each in a process of its own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import (
    JobReturn,
    JobStatus,
    configure_log,
    filter_overrides,
    run_job,
    setup_globals,
)
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from qs3.cluster.ray_tasks import RayTasks
from qs3.errors import Qs3Error

log = logging.getLogger(__name__)


class RayLauncher(Launcher):
    """Runs jobs on a cluster of Ray, or on one that is started here for the time of the sweep.

    A job whose process is killed, or whose node is lost, begins again, and as runs resume, it goes
    on from its last epoch. Its overrides and results travel; `paths.log_dir` and the data have to
    be on a disk that all nodes see.

    Args:
        address: as of `qs3.cluster.ray_tasks.RayTasks`.
        jobs: at the same time, on a cluster that is started here.
        cpus, gpus, memory_gb: that a job takes; a GPU may be shared: 0.25.
        attempts: a job that has ended its process so often is given up.
    """

    def __init__(
        self,
        address: str = "local",
        jobs: int = 2,
        cpus: float = 1,
        gpus: float = 0,
        memory_gb: float | None = None,
        attempts: int = 3,
    ) -> None:
        # Checked in `launch`: what is raised here Hydra shows as a fault of its own.
        self.settings: dict[str, Any] = {
            "address": address,
            "workers": jobs,
            "cpus": cpus,
            "gpus": gpus,
            "memory_gb": memory_gb,
            "attempts": attempts,
            "tasks_per_process": 1,
        }

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Called by Hydra before `launch`."""
        self.hydra_context, self.config = hydra_context, config
        self.task_function = task_function

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run jobs, each a list of overrides, and wait for all; in their order.

        Raises:
            CompactHydraException: a setting cannot be, or there is no such cluster.
        """
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        Path(str(self.config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        numbers = range(initial_job_idx, initial_job_idx + len(job_overrides))
        for number, overrides in zip(numbers, job_overrides, strict=True):
            log.info("\t#%d : %s", number, " ".join(filter_overrides(overrides)))
        maker = _Maker(
            self.hydra_context, self.config, self.task_function, dict(Singleton.get_state())
        )
        tasks = (
            (str(number), (number, list(overrides)))
            for number, overrides in zip(numbers, job_overrides, strict=True)
        )
        found: dict[int, JobReturn] = {}
        try:
            for outcome in RayTasks(**self.settings).run(maker, tasks):
                found[int(outcome.name)] = outcome.result or _lost()
                log.info("#%s has ended: %d of %d jobs", outcome.name, len(found), len(numbers))
        except Qs3Error as error:
            raise CompactHydraException(f"{type(error).__name__}: {error}") from error
        return [found[number] for number in numbers]


@dataclass(frozen=True)
class _Maker:
    """What a process has to know before it can run a job."""

    context: HydraContext
    config: DictConfig
    task: TaskFunction
    singletons: dict[Any, Any]

    def __call__(self) -> Callable[[tuple[int, list[str]]], JobReturn]:
        setup_globals()
        Singleton.set_state(self.singletons)
        return partial(_run, self)


def _run(of: _Maker, job: tuple[int, list[str]]) -> JobReturn:
    number, overrides = job
    config = of.context.config_loader.load_sweep_config(of.config, overrides)
    with open_dict(config):
        config.hydra.job.id = f"{config.hydra.job.name}_{number}"
        config.hydra.job.num = number
    HydraConfig.instance().set_config(config)
    return run_job(
        hydra_context=of.context,
        config=config,
        task_function=of.task,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
    )


def _lost() -> JobReturn:
    """A job that never came to its end; the sweep's summary names it."""
    result = JobReturn(status=JobStatus.FAILED)
    result.return_value = CompactHydraException("the process of a job was killed again and again")
    return result
