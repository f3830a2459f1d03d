"""Tasks on a cluster of Ray, or on one that is started here for the time of a run.

Each task is a task of Ray Core: where it runs is Ray's decision, nodes may come and go, and what
it returns comes back through Ray's object store, so nodes need no disk in common. Retries are
counted here and not by Ray, which begins a task that was out of memory again for ever.
"""

import logging
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import field
from types import ModuleType
from typing import Annotated, Any

from annotated_types import Ge, Gt

from qs3.errors import ConfigError
from qs3.utils.pool import Maker, Outcome, Outcomes, Result, Task, Tasks
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_POLL_S = 1.0


@settings
class RayTasks:
    """Does named tasks on a Ray cluster; see `qs3.utils.pool.Pool`.

    Args:
        address: "local" starts Ray on this machine and ends it with the run; "auto" is the cluster
            that this machine belongs to; else its address, such as "10.0.0.1:6379" or, from
            outside, "ray://10.0.0.1:10001".
        workers: of a local cluster, the number of processes.
        cpus, gpus: cores and graphics cards that a task takes; a card may be shared: 0.25.
        memory_gb: that a task asks for, so that a node takes no more of them than fit; None: not
            said.
        attempts: a task whose process has ended, or whose node was lost, so often is given up.
        tasks_per_process: after so many a process is replaced.
        shared_disk: all nodes see the files of this machine under the same paths, so that workers
            read meshes and write results themselves; else they are sent.
    """

    address: str = "local"
    workers: Annotated[int, Ge(1)] = 2
    cpus: Annotated[float, Gt(0)] = 1
    gpus: Annotated[float, Ge(0)] = 0
    memory_gb: Annotated[float, Gt(0)] | None = None
    attempts: Annotated[int, Ge(1)] = 3
    tasks_per_process: Annotated[int, Ge(1)] = 200
    shared_disk: bool = True
    elsewhere: bool = field(default=True, init=False)

    @property
    def memory_bytes(self) -> int:
        """That a task asks for."""
        return int((self.memory_gb or 0) * 2**30)

    @property
    def at_once(self) -> int:
        """Tasks at once of a cluster that is connected, as many as its cores allow."""
        if (ray := sys.modules.get("ray")) is None or not ray.is_initialized():
            return self.workers
        has = ray.cluster_resources()
        most = has.get("CPU", 0) / self.cpus
        return max(1, int(min(most, has.get("GPU", 0) / self.gpus) if self.gpus else most))

    def run(self, make_worker: Maker[Task, Result], tasks: Tasks[Task]) -> Outcomes[Result]:
        """Do the tasks; as `qs3.utils.pool.Processes.run`.

        Raises:
            ConfigError: no node of the cluster has what a task asks for.
            ConnectionError: Ray's, if the address has no cluster.
        """
        import ray

        with _connected(ray, self):
            memory: dict[str, Any] = {"memory": self.memory_bytes} if self.memory_bytes else {}
            remote = ray.remote(
                num_cpus=self.cpus,
                num_gpus=self.gpus,
                max_calls=self.tasks_per_process,
                max_retries=0,
                **memory,
            )(_do)
            # The key is of this run: a process of Ray may have served another one.
            maker, key = ray.put(make_worker), os.urandom(16)
            waiting = iter(tasks)
            pending: dict[Any, tuple[str, Any]] = {}
            again: list[tuple[str, Any]] = []
            deaths: Counter[str] = Counter()
            try:
                while True:
                    # Twice as many as can run: a free core need not wait for this process.
                    while len(pending) < 2 * self.at_once:
                        work = again.pop() if again else next(waiting, None)
                        if work is None:
                            break
                        pending[remote.remote(maker, key, work[1])] = work
                    if not pending:
                        return
                    ready, _ = ray.wait(list(pending), timeout=_POLL_S)
                    for ref in ready:
                        work = pending.pop(ref)
                        if (outcome := self._outcome(ray, ref, work[0], deaths)) is not None:
                            yield outcome
                        else:
                            again.append(work)
            finally:
                for ref in pending:
                    with suppress(Exception):  # it has ended by now, or the cluster is gone
                        ray.cancel(ref, force=True)

    def _outcome(
        self, ray: ModuleType, ref: Any, name: str, deaths: Counter[str]
    ) -> Outcome[Any] | None:
        """What became of a task; None if it is to be done again."""
        errors = ray.exceptions
        try:
            return Outcome(name, ray.get(ref))
        except errors.RayTaskError as error:  # the worker's own error ends everything
            raise error.cause if isinstance(error.cause, Exception) else error from error
        except (
            errors.NodeDiedError, errors.ObjectLostError, errors.OwnerDiedError,
            errors.WorkerCrashedError, errors.OutOfMemoryError,
        ) as error:  # fmt: skip
            log.warning("%s: its process or node is gone (%s)", name, type(error).__name__)
        deaths[name] += 1
        return Outcome(name, None, died=True) if deaths[name] >= self.attempts else None


_WORKERS: dict[bytes, Any] = {}
"""In a process of Ray: the worker of the run that it serves."""


def _do(make_worker: Callable[[], Any], key: bytes, task: Any) -> Any:
    """A task of Ray."""
    if key not in _WORKERS:
        _WORKERS.clear()
        _WORKERS[key] = make_worker()
    return _WORKERS[key](task)


@contextmanager
def _connected(ray: ModuleType, how: RayTasks) -> Iterator[None]:
    """Ray at the address, for as long as the run takes."""
    if ray.is_initialized():  # by whoever called us from Python: theirs to end
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    quiet = {"log_to_driver": False, "logging_level": logging.WARNING, "configure_logging": False}
    local: dict[str, Any] = {}
    if how.address == "local":
        # More processes than cores are the caller's choice; a task with more than all is an error.
        cores = math.ceil(how.workers * how.cpus) if how.cpus <= (os.cpu_count() or 1) else None
        local = {"num_cpus": cores, "include_dashboard": False}
    try:
        ray.init(address=how.address, **local, **quiet)
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        log.info("Ray: %d nodes, %d cores", len(nodes), ray.cluster_resources().get("CPU", 0))
        needs = {"CPU": how.cpus, "GPU": how.gpus, "memory": how.memory_bytes}
        # Else Ray would wait for ever.
        if not any(all(has.get(k, 0) >= n for k, n in needs.items()) for has in nodes):
            raise ConfigError(f"no node of the cluster has what a task asks for: {needs}")
        yield
    finally:
        ray.shutdown()
