"""The same tasks by processes, by Ray and by array jobs: one behaviour."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from qs3.cluster.ray_tasks import RayTasks
from qs3.cluster.slurm_arrays import SlurmArrays
from qs3.errors import ConfigError, MeshError
from qs3.utils.pool import Processes

slow = pytest.mark.slow


def arrays(folder, **more):
    given = {"cluster": "local", "jobs": 2, "tasks_per_job": 3, "poll_s": 0.2, "time_limit_min": 5}
    return SlurmArrays(folder=str(folder), **{**given, **more})


ENGINES = {
    "local": lambda folder: Processes(2),
    "ray": lambda folder: RayTasks(workers=2, tasks_per_process=4),
    "slurm": arrays,
}
engines = pytest.mark.parametrize(
    "engine", [pytest.param(make, id=name) for name, make in ENGINES.items()]
)


class Worker:
    """Squares numbers, and does what words say."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, task):
        if isinstance(task, int):
            return np.full(100_000, task**2)  # does not fit into a message of Ray's
        word, name = task
        (self.folder / f"{name}.{os.getpid()}.{time.monotonic_ns()}").touch()
        if word == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "fail":
            raise MeshError("chair.off: no faces")
        if word == "sleep":
            time.sleep(600)
        return word


def make_worker(folder):
    return functools.partial(Worker, folder)


@slow
@engines
def test_each_task_has_its_outcome(engine, tmp_path):
    tasks = [(str(i), i) for i in range(11)]
    found = {o.name: o.result for o in engine(tmp_path / "own").run(make_worker(tmp_path), tasks)}
    assert {name: int(result[-1]) for name, result in found.items()} == {
        str(i): i * i for i in range(11)
    }
    assert list(engine(tmp_path / "own").run(make_worker(tmp_path), [])) == []


@slow
@engines
def test_a_deadly_task_costs_only_itself(engine, tmp_path):
    tasks = [(str(i), i) for i in range(7)]
    tasks.insert(2, ("deadly", ("die", "deadly")))
    pool = engine(tmp_path / "own")
    outcomes = {o.name: o for o in pool.run(make_worker(tmp_path), tasks)}
    assert set(outcomes) == {name for name, _ in tasks}
    assert outcomes.pop("deadly").died
    assert not any(o.died for o in outcomes.values())
    assert int(outcomes["6"].result[0]) == 36
    tries = len(list(tmp_path.glob("deadly.*")))
    assert tries == getattr(pool, "attempts", 2)


@slow
@engines
def test_what_a_worker_raises_ends_everything_as_what_it_is(engine, tmp_path):
    tasks = [("0", 0), ("bad", ("fail", "bad")), *((str(i), i) for i in range(1, 4))]
    with pytest.raises(MeshError, match=r"chair\.off: no faces"):
        list(engine(tmp_path / "own").run(make_worker(tmp_path), tasks))


def alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@slow
@engines
def test_nothing_goes_on_when_the_caller_stops(engine, tmp_path):
    """As with Ctrl-C, which ends the loop."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a test in the background ignores it
    tasks = [("first", 1), ("a", ("sleep", "a")), ("b", ("sleep", "b"))]
    more = {"tasks_per_job": 1} if engine is arrays else {}  # results come job by job
    outcomes = engine(tmp_path / "own", **more).run(make_worker(tmp_path), tasks)
    assert next(outcomes).name == "first"
    end = time.monotonic() + 60
    while not (there := list(tmp_path.glob("a.*"))) and time.monotonic() < end:
        time.sleep(0.1)
    pids = [int(path.name.split(".")[1]) for path in there]
    assert len(pids) == 1
    outcomes.close()
    while any(map(alive, pids)) and time.monotonic() < end:
        time.sleep(0.1)
    assert not any(map(alive, pids))


AT_THE_TIME_LIMIT = """
import os, signal
from qs3.cluster.slurm_arrays import _do

def work(task):
    os.kill(os.getpid(), signal.SIGUSR2)

signal.signal(signal.SIGUSR2, lambda *_: (_ for _ in ()).throw(RuntimeError("timed-out")))
_do(lambda: work, [("a", "slow")])
"""


def test_the_time_limit_is_not_a_failure_of_the_task():
    """Submitit raises an error in the middle of the task; the process has to end instead."""
    done = subprocess.run([sys.executable, "-c", AT_THE_TIME_LIMIT], check=False)
    assert done.returncode == -signal.SIGUSR2


@pytest.mark.slow
def test_what_no_node_has_is_an_error_at_once():
    """Ray itself would wait for ever."""
    with pytest.raises(ConfigError):
        list(RayTasks(workers=1, cpus=1e6).run(int, [("a", 1)]))
