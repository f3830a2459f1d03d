"""The pool: the same outcomes here and in processes, and processes that die."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from joblib import Parallel, delayed

from qs3.errors import DataError
from qs3.utils.pool import Processes
from tests.utils.pool_work import die_at_once, make, no_worker, pids_in_a_job


def run(tasks, workers=2, **settings):
    return {o.name: o for o in Processes(workers, **settings).run(make, tasks)}


def squares(n):
    return [(f"task {i}", ("square", i)) for i in range(n)]


@pytest.mark.parametrize("workers", [0, 3])
def test_any_number_of_workers_gives_the_same(workers):
    outcomes = Processes(workers).run(make, squares(7))
    assert sorted((o.name, o.result, o.died) for o in outcomes) == [
        (f"task {i}", i * i, False) for i in range(7)
    ]
    assert list(Processes(workers).run(make, [])) == []


def test_a_deadly_task_costs_only_itself_and_an_unlucky_one_nothing(tmp_path):
    tasks = squares(6)
    tasks[2:2] = [("deadly", ("kill", None)), ("unlucky", ("kill once", tmp_path / "tried"))]
    outcomes = run(tasks)
    assert outcomes.pop("deadly").died
    assert outcomes.pop("unlucky").result == "survived"
    assert {name: o.result for name, o in outcomes.items()} == {
        f"task {i}": i * i for i in range(6)
    }


@pytest.mark.slow
def test_a_worker_that_cannot_start_is_the_death_of_each_task():
    assert all(o.died for o in Processes(2).run(die_at_once, squares(3)))


@pytest.mark.parametrize("workers", [0, 1])
def test_errors_end_everything_and_stay_what_they_are(workers):
    tasks = [("bad", ("raise", DataError("broken file"))), *squares(3)]
    with pytest.raises(DataError, match="broken file"):
        list(Processes(workers).run(make, tasks))
    with pytest.raises(DataError, match="no licence"):
        list(Processes(workers).run(no_worker, squares(3)))


def test_an_error_arrives_whether_it_can_be_pickled_or_not():
    with pytest.raises(KeyError) as error:
        run([("bad", ("raise", KeyError("x")))])
    assert "in work" in error.value.__notes__[0]
    with pytest.raises(RuntimeError, match="Strange: 1 and 2"):
        run([("bad", ("raise strange", None))])


@pytest.mark.slow
def test_processes_are_replaced_after_a_number_of_tasks():
    tasks = [(str(i), ("pid", None)) for i in range(5)]
    pids = [o.result for o in Processes(1, tasks_per_process=2).run(make, tasks)]
    assert [pids.count(pid) for pid in dict.fromkeys(pids)] == [2, 2, 1]
    assert os.getpid() not in pids


def test_tasks_are_taken_when_somebody_is_free_and_large_messages_pass():
    taken = []

    def tasks():
        for i in range(8):
            taken.append(i)
            yield str(i), ("large", 8_000_000)

    outcomes = Processes(2).run(make, tasks())
    first = next(outcomes)
    assert len(first.result) == 8_000_000
    assert len(taken) <= 4
    assert len(list(outcomes)) == 7


def alive(pid):
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def test_whoever_stops_taking_outcomes_leaves_no_process():
    outcomes = Processes(2).run(make, [(str(i), ("pid", None)) for i in range(50)])
    pids = {next(outcomes).result for _ in range(4)}
    outcomes.close()
    assert not any(map(alive, pids))


SCRIPT = """
import signal
from qs3.utils.pool import Processes
from tests.utils.pool_work import make_sleepers
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored if tests run behind an &
    list(Processes(2).run(make_sleepers, [("a", 600), ("b", 600), ("c", 600)]))
"""


def children(pid):
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=lambda how: how.name)
def test_processes_end_with_their_parent_while_they_work(tmp_path, how):
    (tmp_path / "script.py").write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py")],
        env={**os.environ, "PYTHONPATH": os.getcwd()},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert until(lambda: len(children(process.pid)) >= 3)  # two workers, a resource tracker
        workers = children(process.pid)
        time.sleep(0.5)  # they are at work, or about to be
        process.send_signal(how)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert until(lambda: not any(map(alive, workers)))
    assert errors.count("Traceback") == (how == signal.SIGINT)  # the parent's


def test_processes_start_in_a_job_of_joblibs(capfd):
    """Where the default start method is one that a new process does not know."""
    tasks = [("a", ("square", 3)), ("b", ("square", 4))]
    for before, after, found in Parallel(n_jobs=2)(delayed(pids_in_a_job)(tasks) for _ in range(2)):
        assert (before, after) == ("loky", "loky")
        assert sorted((one.name, one.result) for one in found) == [("a", 9), ("b", 16)]
    assert capfd.readouterr().err == ""


UNGUARDED = """
from qs3.utils.pool import Processes
from tests.utils.pool_work import make
print("begun")
print([outcome.result for outcome in Processes(2).run(make, [("a", ("square", 3))])])
"""
OF_ITS_OWN = """
from qs3.utils.pool import Processes
def double(x):
    return 2 * x
def make():
    return double
if __name__ == "__main__":
    print([outcome.result for outcome in Processes(2).run(make, [("a", 3)])])
"""


@pytest.mark.parametrize(("script", "said"), [(UNGUARDED, "begun\n[9]\n"), (OF_ITS_OWN, "[6]\n")])
def test_a_script_runs_once_and_what_it_defines_is_found(tmp_path, script, said):
    (tmp_path / "script.py").write_text(script)
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == (said, "")
