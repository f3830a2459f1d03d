"""How long many tasks take on many nodes, some of which are slow and some of which fail.

A simulation by events, with what was measured of the tasks: list scheduling (whoever is free takes
the next), as the engines do it. Nothing here runs a task.
"""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Float

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError

_DONE, _DOWN, _UP = range(3)
_MOST_LIVES = 5.0  # a task that needs more of a node's mean lives would hardly ever be done


@dataclass(frozen=True)
class Nodes:
    """The machines, and what becomes of them.

    Args:
        number: of nodes.
        workers: tasks that a node does at once.
        start_s: that a worker takes before its first task (imports, the renderer).
        life_h: mean time from a node's start to its failure, drawn exponentially; None: none fails.
        repair_min: until it, or another in its place, is there again.
        slow_share: chance of a node to be slow.
        slow_times: how many times as long each task takes on such a node.

    Raises:
        ConfigError: a value cannot be.
    """

    number: int
    workers: int
    start_s: float = 0.0
    life_h: float | None = None
    repair_min: float = 10.0
    slow_share: float = 0.0
    slow_times: float = 2.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            number="[1, inf)",
            workers="[1, inf)",
            start_s="[0, inf)",
            repair_min="[0, inf)",
            slow_share="[0, 1]",
            slow_times="[1, inf)",
            life_h="(0, inf)",
        )


@dataclass(frozen=True)
class Course:
    """What happened.

    Attributes:
        hours: from the beginning to the end of the last task.
        lost_h: hours of workers on tasks, and starts, that a failure cut off.
        idle_h: hours of workers that had nothing to do, or whose node was down.
        failures: of nodes.
    """

    hours: float
    lost_h: float
    idle_h: float
    failures: int


@dataclass
class _Worker:
    node: int
    fresh: bool = True  # it has to start before its next task
    job: np.ndarray | None = None  # seconds of the tasks it has, on this node
    given: float = 0.0
    began: float = 0.0  # the first of them


def simulate(
    seconds: Float[np.ndarray, " n"],
    nodes: Nodes,
    *,
    tasks_per_job: int = 1,
    start_each_job: bool = False,
    seed: int = 0,
) -> Course:
    """One course of n tasks in this order.

    Args:
        seconds: of each task on a node that is not slow.
        nodes: that do them.
        tasks_per_job: tasks that are handed out together; what is done of a job when its node
            fails stays done.
        start_each_job: whether a worker starts anew for each job (array jobs do).
        seed: of failures and slow nodes.

    Raises:
        ConfigError: there is no task, or one takes so long that nodes hardly live to its end.
    """
    if len(seconds) == 0 or tasks_per_job < 1:
        raise ConfigError("there is no task to simulate, or a job without one")
    slowest = nodes.slow_times if nodes.slow_share else 1.0
    if nodes.life_h is not None and seconds.max() * slowest > _MOST_LIVES * 3600 * nodes.life_h:
        raise ConfigError(
            f"a task takes up to {seconds.max() * slowest / 3600:.3g} hours, and nodes live for "
            f"{nodes.life_h:g} on average: it would never be done"
        )
    return _Course(seconds, nodes, tasks_per_job, start_each_job, seed).run()


class _Course:
    def __init__(
        self, seconds: np.ndarray, nodes: Nodes, tasks: int, start_each: bool, seed: int
    ) -> None:
        self.nodes, self.start_each = nodes, start_each
        self.rng = np.random.default_rng(seed)
        slow = self.rng.random(nodes.number) < nodes.slow_share
        self.times = np.where(slow, nodes.slow_times, 1.0)
        self.waiting = deque(seconds[i : i + tasks] for i in range(0, len(seconds), tasks))
        self.left = len(seconds)
        self.workers = [_Worker(i % nodes.number) for i in range(nodes.number * nodes.workers)]
        self.free = deque(range(len(self.workers)))
        self.lives = [0] * nodes.number  # how often each node has failed
        self.events: list[tuple[float, int, int, int, int]] = []
        self.order = count()
        self.lost = self.worked = 0.0

    def run(self) -> Course:
        for node in range(self.nodes.number):
            self._lives_until(0.0, node)
        now = 0.0
        self._hand_out(now)
        while self.left:
            now, _, kind, who, life = heapq.heappop(self.events)
            if kind == _DOWN:
                self._fails(who, now)
            elif kind == _UP:
                self.free.extend(range(who, len(self.workers), self.nodes.number))
                self._lives_until(now, who)
            elif life == self.lives[self.workers[who].node]:  # it has not failed meanwhile
                self._done(who, now)
            self._hand_out(now)
        # A worker that has a job now has none of it: the last task is done.
        whole = now * len(self.workers)
        return Course(
            hours=now / 3600,
            lost_h=self.lost / 3600,
            idle_h=(whole - self.worked - self.lost) / 3600,
            failures=sum(self.lives),
        )

    def _hand_out(self, now: float) -> None:
        while self.waiting and self.free:
            i = self.free.popleft()
            worker = self.workers[i]
            worker.job = self.waiting.popleft() * self.times[worker.node]
            start = self.nodes.start_s if worker.fresh or self.start_each else 0.0
            worker.fresh, worker.given, worker.began = False, now, now + start
            end = worker.began + float(worker.job.sum())
            self._push(end, _DONE, i, self.lives[worker.node])

    def _done(self, i: int, now: float) -> None:
        worker = self.workers[i]
        assert worker.job is not None
        self.left -= len(worker.job)
        self.worked += now - worker.given
        worker.job = None
        self.free.append(i)

    def _fails(self, node: int, now: float) -> None:
        self.lives[node] += 1
        self.free = deque(i for i in self.free if self.workers[i].node != node)
        for worker in self.workers[node :: self.nodes.number]:
            worker.fresh = True
            if worker.job is None:
                continue
            ends = worker.began + np.cumsum(worker.job)
            done = int(np.searchsorted(ends, now, side="right"))
            kept = float(ends[done - 1]) if done else worker.given
            self.left -= done
            self.worked += kept - worker.given
            self.lost += now - kept
            rest = worker.job[done:] / self.times[node]
            if len(rest):
                self.waiting.appendleft(rest)
            worker.job = None
        self._push(now + 60 * self.nodes.repair_min, _UP, node, 0)

    def _lives_until(self, now: float, node: int) -> None:
        if self.nodes.life_h is not None:
            life = float(self.rng.exponential(3600 * self.nodes.life_h))
            self._push(now + life, _DOWN, node, 0)

    def _push(self, at: float, kind: int, who: int, life: int) -> None:
        heapq.heappush(self.events, (at, next(self.order), kind, who, life))
