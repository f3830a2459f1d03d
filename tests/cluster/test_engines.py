"""The same tasks by processes, by Ray and by array jobs: one behaviour."""

from __future__ import annotations

import functools
import os
import pickle
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from qs3.cluster.ray_tasks import RayTasks
from qs3.cluster.slurm_arrays import SlurmArrays, _do_chunk, _Job
from qs3.errors import ConfigError, MeshError
from qs3.utils.pool import Processes

slow = pytest.mark.slow


def arrays(folder, **more):
    given = {"cluster": "local", "jobs": 2, "tasks_per_job": 3, "poll_s": 0.2, "time_limit_min": 5}
    return SlurmArrays(folder=str(folder), **given, **more)


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
    outcomes = engine(tmp_path / "own").run(make_worker(tmp_path), tasks)
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


class Handle:
    """Of a job that has ended as it pleases."""

    ended = cancelled = False

    def done(self):
        return self.ended

    def cancel(self):
        self.cancelled = True

    def exception(self):
        return RuntimeError("out of\n memory")


def job(folder, *names):
    return _Job(Handle(), [(name, int(name)) for name in names], folder / "journal-a")


def test_a_journal_is_read_as_far_as_it_is_whole(tmp_path):
    one = job(tmp_path, "1", "2", "3")
    assert list(one.new_outcomes()) == []  # there is no file yet
    _do_chunk(make_worker(tmp_path), one.chunk, tmp_path / "whole")
    (written,) = tmp_path.glob("whole.*")
    whole = written.read_bytes()
    found = []
    for end in range(0, len(whole) + 9973, 9973):
        (tmp_path / "journal-a.1").write_bytes(whole[:end])
        found += one.new_outcomes()
    assert [(o.name, int(o.result[0])) for o in found] == [("1", 1), ("2", 4), ("3", 9)]
    assert one.unfinished(Counter()) == []


def test_a_job_that_was_begun_anew_has_another_journal(tmp_path):
    """The first start was cut off in the middle of a record."""
    one = job(tmp_path, "1", "2")
    _do_chunk(make_worker(tmp_path), one.chunk[:1], one.journal)
    (first,) = one.files()
    first.write_bytes(first.read_bytes()[:-7])
    assert list(one.new_outcomes()) == []
    _do_chunk(make_worker(tmp_path), one.chunk, one.journal)
    assert len(one.files()) == 2
    assert [o.name for o in one.new_outcomes()] == ["1", "2"]
    _do_chunk(make_worker(tmp_path), one.chunk, one.journal)
    assert list(one.new_outcomes()) == []  # each task once


def test_the_task_during_which_a_job_ended_is_charged(tmp_path):
    one, deaths = job(tmp_path, "1", "2", "3"), Counter()
    _do_chunk(make_worker(tmp_path), one.chunk[:1], one.journal)
    with one.files()[0].open("ab") as file:
        file.write(pickle.dumps(("2", None)) + pickle.dumps(("3", None))[:7])
    assert [o.name for o in one.new_outcomes()] == ["1"]
    assert one.unfinished(deaths) == [("2", 2), ("3", 3)]
    assert deaths == {"2": 1}
    (tmp_path / "none").mkdir()
    fresh = job(tmp_path / "none", "4", "5")
    assert fresh.unfinished(deaths) == [("4", 4), ("5", 5)]
    assert deaths == {"2": 1, "4": 1}


def test_a_job_of_which_slurm_says_nothing_ends_some_time(tmp_path):
    one = job(tmp_path, "1")
    assert not one.ended(limit_s=0)  # it may still be waiting in the queue
    _do_chunk(make_worker(tmp_path), one.chunk, one.journal)
    list(one.new_outcomes())
    assert not one.ended(limit_s=1000)
    assert one.ended(limit_s=0)
    assert one.handle.cancelled
    one.handle.ended = True
    assert one.ended(limit_s=1000)


AT_THE_TIME_LIMIT = """
import os, signal, sys
from pathlib import Path
from qs3.cluster.slurm_arrays import _do_chunk

def work(task):
    if task == "slow":
        os.kill(os.getpid(), signal.SIGUSR2)
    return task

signal.signal(signal.SIGUSR2, lambda *_: (_ for _ in ()).throw(RuntimeError("timed-out")))
_do_chunk(lambda: work, [("a", "quick"), ("b", "slow"), ("c", "quick")], Path(sys.argv[1]))
"""


def test_the_time_limit_is_not_a_failure_of_the_task(tmp_path):
    """Submitit raises an error in the middle of the task; the process has to end instead."""
    journal = tmp_path / "journal-a"
    done = subprocess.run([sys.executable, "-c", AT_THE_TIME_LIMIT, str(journal)], check=False)
    assert done.returncode == -signal.SIGUSR2
    one = _Job(Handle(), [("a", 0), ("b", 0), ("c", 0)], journal)
    assert [(o.name, o.result) for o in one.new_outcomes()] == [("a", "quick")]
    deaths = Counter()
    assert [name for name, _ in one.unfinished(deaths)] == ["b", "c"]
    assert deaths == {"b": 1}


@pytest.mark.slow
def test_what_no_node_has_is_an_error_at_once():
    """Ray itself would wait for ever."""
    with pytest.raises(ConfigError):
        list(RayTasks(workers=1, cpus=1e6).run(int, [("a", 1)]))
