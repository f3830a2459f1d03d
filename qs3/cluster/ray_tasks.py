"""Tasks on a cluster of Ray, or on one that is started here for the time of a run.

Each task is a task of Ray Core: where it runs is Ray's decision, nodes may come and go, and what
it returns comes back through Ray's object store, so nodes need no disk in common. Retries are
counted here and not by Ray, because who ended the process matters: a task that does so several
times is given up, one whose node was lost is not to blame.
"""

from __future__ import annotations

import logging
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from qs3.config.checks import check_float, check_int
from qs3.errors import ClusterError, ConfigError
from qs3.utils.plural import counted
from qs3.utils.pool import Outcome, Result, Task

log = logging.getLogger(__name__)

_POLL_S = 1.0
_LOST_NODES = 10  # with one task: more is no accident
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0"}


@dataclass
class _Work:
    """A task on its way: how often its process ended, and how often its node was lost."""

    name: str
    task: Any
    deaths: int = 0
    lost: int = 0


@dataclass(frozen=True)
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
        attempts: a task that has ended its process so often is given up.
        tasks_per_process: after so many a process is replaced.
        place: of these settings, for messages.
        shared_disk: all nodes see the files of this machine under the same paths, so that workers
            read meshes and write results themselves; else they are sent.

    Raises:
        ConfigError: a value cannot be.
    """

    address: str = "local"
    workers: int = 2
    cpus: float = 1
    gpus: float = 0
    memory_gb: float | None = None
    attempts: int = 3
    tasks_per_process: int = 200
    shared_disk: bool = True
    place: str = "engine"
    elsewhere: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        check_int("workers", self.workers, 1)
        check_int(f"{self.place}.attempts", self.attempts, 1)
        check_int(f"{self.place}.tasks_per_process", self.tasks_per_process, 1)
        check_float(f"{self.place}.cpus", self.cpus, "(0, inf)")
        check_float(f"{self.place}.gpus", self.gpus, "[0, inf)")
        if self.memory_gb is not None:
            check_float(f"{self.place}.memory_gb", self.memory_gb, "(0, inf)")
        if not isinstance(self.address, str) or not self.address.strip():
            raise ConfigError(
                f"{self.place}.address must be local, auto or an address, got {self.address!r}"
            )

    @property
    def memory_bytes(self) -> int:
        """That a task asks for."""
        return int((self.memory_gb or 0) * 2**30)

    @property
    def at_once(self) -> int:
        """Of a cluster that is connected, as many as its cores allow."""
        if (ray := sys.modules.get("ray")) is None or not ray.is_initialized():
            return self.workers
        has = ray.cluster_resources()
        most = has.get("CPU", 0) / self.cpus
        return max(1, int(min(most, has.get("GPU", 0) / self.gpus) if self.gpus else most))

    def run(
        self,
        make_worker: Callable[[], Callable[[Task], Result]],
        tasks: Iterable[tuple[str, Task]],
    ) -> Iterator[Outcome[Result]]:
        """Do the tasks; as `qs3.utils.pool.Processes.run`.

        Raises:
            ConfigError: Ray is not installed, there is no cluster at the address, or none of its
                nodes has what a task asks for.
        """
        ray = _ray()
        with _connected(ray, self):
            yield from _Run(ray, self, make_worker).outcomes(tasks)


class _Run:
    """One call of `RayTasks.run`, with the cluster at hand."""

    def __init__(self, ray: ModuleType, how: RayTasks, make_worker: Callable[[], Any]) -> None:
        self.ray, self.how = ray, how
        memory = {} if how.memory_gb is None else {"memory": how.memory_bytes}
        self.remote = ray.remote(
            num_cpus=how.cpus,
            num_gpus=how.gpus,
            max_calls=how.tasks_per_process,
            max_retries=0,
            **memory,
        )(_do)
        self.make_worker = ray.put(make_worker)
        self.key = os.urandom(16)  # of this run: a process of Ray may have served another one
        self.pending: dict[Any, _Work] = {}
        self.again: list[_Work] = []
        self.nodes: Counter[str] = Counter()
        self.troubles: Counter[str] = Counter()

    def outcomes(self, tasks: Iterable[tuple[str, Any]]) -> Iterator[Outcome[Any]]:
        waiting = (_Work(name, task) for name, task in tasks)
        try:
            while True:
                # Twice as many as can run: a core that gets free need not wait for this process.
                while len(self.pending) < 2 * self.how.at_once:
                    work = self.again.pop() if self.again else next(waiting, None)
                    if work is None:
                        break
                    self.pending[self.remote.remote(self.make_worker, self.key, work.task)] = work
                if not self.pending:
                    self._report()
                    return
                ready, _ = self.ray.wait(list(self.pending), timeout=_POLL_S)
                for ref in ready:
                    if (outcome := self._outcome(ref, self.pending.pop(ref))) is not None:
                        yield outcome
        finally:
            for ref in self.pending:
                with suppress(Exception):  # it has ended by now, or the cluster is gone
                    self.ray.cancel(ref, force=True)

    def _outcome(self, ref: Any, work: _Work) -> Outcome[Any] | None:
        """What became of a task; None if it is to be done again."""
        errors = self.ray.exceptions
        try:
            node, result = self.ray.get(ref)
        except errors.RayTaskError as error:  # the worker's own error ends everything
            raise error.cause if isinstance(error.cause, Exception) else error from error
        except (errors.NodeDiedError, errors.ObjectLostError, errors.OwnerDiedError) as error:
            work.lost += 1
            self._note("a node was lost", work, error)
            if work.lost >= _LOST_NODES:
                return Outcome(work.name, None, died=True)
        except (errors.WorkerCrashedError, errors.OutOfMemoryError) as error:
            work.deaths += 1
            self._note("a process ended", work, error)
            if work.deaths >= self.how.attempts:
                return Outcome(work.name, None, died=True)
        except errors.RayError as error:
            raise ClusterError(
                f"Ray ended the run at {work.name}: {type(error).__name__}: "
                f"{' '.join(str(error).split())[:300]}. Run the same command again: it goes on"
            ) from error
        else:
            self.nodes[node] += 1
            return Outcome(work.name, result)
        self.again.append(work)
        return None

    def _note(self, what: str, work: _Work, error: Exception) -> None:
        self.troubles[what] += 1
        log.warning("%s: %s (%s)", work.name, what, type(error).__name__)

    def _report(self) -> None:
        """Who did how much, and what went wrong on the way."""
        shares = ", ".join(f"{n} by {node}" for node, n in self.nodes.most_common())
        log.info("%s: %s", counted(len(self.nodes), "node"), shares)
        for what, count in self.troubles.items():
            log.warning("%s %s; what it had was done again", counted(count, "time"), what)


_WORKERS: dict[bytes, Any] = {}
"""In a process of Ray: the worker of the run that it serves."""


def _do(make_worker: Callable[[], Any], key: bytes, task: Any) -> tuple[str, Any]:
    """A task of Ray: the name of its node, and the result."""
    import ray

    if key not in _WORKERS:
        _WORKERS.clear()
        _WORKERS[key] = make_worker()
    context = ray.get_runtime_context()
    return f"{ray.util.get_node_ip_address()} ({context.get_node_id()[:6]})", _WORKERS[key](task)


@contextmanager
def _connected(ray: ModuleType, how: RayTasks) -> Iterator[None]:
    """Ray at the address, for as long as the run takes."""
    if ray.is_initialized():  # by whoever called us from Python: theirs to end
        yield
        return
    kept = {name: os.environ.get(name) for name in _QUIET}
    os.environ.update({name: os.environ.get(name, value) for name, value in _QUIET.items()})
    quiet = {"log_to_driver": False, "logging_level": logging.WARNING, "configure_logging": False}
    local: dict[str, Any] = {}
    if how.address == "local":
        # More processes than cores are the caller's choice; a task with more than all is an error.
        cores = math.ceil(how.workers * how.cpus) if how.cpus <= (os.cpu_count() or 1) else None
        local = {"num_cpus": cores, "include_dashboard": False}
    try:
        try:
            ray.init(address=how.address, **local, **quiet)
        except ConnectionError as error:
            raise ConfigError(
                f"there is no Ray cluster at {how.place}.address={how.address}: start one "
                f"(`ray start --head`) or take {how.place}.address=local"
            ) from error
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        cpus = int(ray.cluster_resources().get("CPU", 0))
        log.info("Ray: %s, %s", counted(len(nodes), "node"), counted(cpus, "core"))
        if not any(
            has.get("CPU", 0) >= how.cpus
            and has.get("GPU", 0) >= how.gpus
            and has.get("memory", 0) >= how.memory_bytes
            for has in nodes
        ):
            raise ConfigError(
                f"no node of the cluster has {how.place}.cpus={counted(how.cpus, 'core')}, "
                f"{how.place}.gpus={counted(how.gpus, 'card')} and "
                f"{how.place}.memory_gb={how.memory_gb or 0} of memory"
            )
        yield
    finally:
        ray.shutdown()
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)


def _ray() -> ModuleType:
    try:
        import ray
    except ImportError as error:
        raise ConfigError(
            "Ray is not installed: pip install '.[cluster]' in the folder of qs3"
        ) from error
    module: ModuleType = ray
    return module
