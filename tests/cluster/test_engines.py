"""The same tasks by processes, by Ray and by array jobs: one behaviour."""

from __future__ import annotations

import functools
import os
import pickle
import signal
import struct
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
    given = {"cluster": "local", "jobs": 2, "tasks_per_job": 3, "poll_s": 0.2, "minutes": 5}
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
    """As with Ctrl-C, which ends the loop over the outcomes."""
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

    def exception(self):
        return RuntimeError("out of\n memory")


def job(folder, *names):
    return _Job(Handle(), [(name, int(name)) for name in names], folder / "a.journal")


def test_a_journal_is_read_as_far_as_it_is_whole(tmp_path):
    one = job(tmp_path, "1", "2", "3")
    assert list(one.new_outcomes()) == []  # there is no file yet
    _do_chunk(make_worker(tmp_path), one.chunk, tmp_path / "whole")
    whole = (tmp_path / "whole").read_bytes()
    found = []
    for end in range(0, len(whole) + 9973, 9973):
        one.journal.write_bytes(whole[:end])
        found += one.new_outcomes()
    assert [(o.name, int(o.result[0])) for o in found] == [("1", 1), ("2", 4), ("3", 9)]
    assert one.unfinished(Counter()) == []


def test_the_task_during_which_a_job_ended_is_charged(tmp_path):
    one, deaths = job(tmp_path, "1", "2", "3"), Counter()
    _do_chunk(make_worker(tmp_path), one.chunk[:1], one.journal)
    record = pickle.dumps(("2", None))
    with one.journal.open("ab") as file:
        file.write(struct.pack("<Q", len(record)) + record + b"\x07")
    assert [o.name for o in one.new_outcomes()] == ["1"]
    assert one.unfinished(deaths) == [("2", 2), ("3", 3)]
    assert deaths == {"2": 1}
    fresh = job(tmp_path / "none", "4", "5")
    assert fresh.unfinished(deaths) == [("4", 4), ("5", 5)]
    assert deaths == {"2": 1, "4": 1}


def test_a_jobs_error_is_raised_here(tmp_path):
    one = _Job(Handle(), [("bad", ("fail", "bad")), ("1", 1)], tmp_path / "a.journal")
    _do_chunk(make_worker(tmp_path), one.chunk, one.journal)
    with pytest.raises(MeshError, match="no faces"):
        list(one.new_outcomes())


@pytest.mark.parametrize(
    ("engine", "wrong", "said"),
    [
        (RayTasks, {"workers": 0}, "workers"),
        (RayTasks, {"attempts": 0}, r"engine\.attempts"),
        (RayTasks, {"cpus": 0}, r"engine\.cpus"),
        (RayTasks, {"memory_gb": -1.0}, r"engine\.memory_gb"),
        (RayTasks, {"address": " "}, r"engine\.address"),
        (arrays, {"cpus": 0}, r"engine\.cpus"),
        (SlurmArrays, {"cluster": "pbs"}, r"engine\.cluster.*slurm"),
    ],
)
def test_settings_that_cannot_be(engine, wrong, said, tmp_path):
    given = {} if engine is RayTasks else {"folder": str(tmp_path)}
    with pytest.raises(ConfigError, match=said):
        engine(**given, **wrong)


def test_no_slurm_here_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"engine=slurm: .*engine\.cluster=local"):
        list(SlurmArrays(folder=str(tmp_path)).run(make_worker(tmp_path), [("1", 1)]))


@slow
def test_no_cluster_at_the_address_is_said(tmp_path):
    with pytest.raises(ConfigError, match=r"no Ray cluster at .*ray start --head"):
        list(RayTasks(address="auto").run(make_worker(tmp_path), [("1", 1)]))
