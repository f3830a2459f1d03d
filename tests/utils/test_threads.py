"""Threads: how many, and how they wait."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from qs3.utils import threads

ROOT = Path(__file__).parents[2]
BEGINNING = (
    "from qs3.utils.cli import run, Command; run(Command('c', 'x', lambda: 0, (), ()), []); "
)


def openmp_says(code: str, **environment: str) -> str:
    """What OpenMP prints of its settings when torch is loaded."""
    kept = {name: value for name, value in os.environ.items() if name not in threads.WAITING}
    given = {**kept, "OMP_DISPLAY_ENV": "VERBOSE", **environment}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env=given, cwd=ROOT, capture_output=True, text=True, check=True
    ).stderr


@pytest.mark.skipif(sys.platform != "linux", reason="torch brings another OpenMP elsewhere")
def test_openmps_threads_sleep_unless_somebody_says_otherwise():
    assert "GOMP_SPINCOUNT = '0'" in openmp_says(BEGINNING + "import torch")
    (openmp,) = Path(find_spec("torch").origin).parent.glob("lib/libgomp*")
    alone = f"{BEGINNING}import ctypes; ctypes.CDLL({str(openmp)!r})"  # torch takes seconds
    assert "GOMP_SPINCOUNT = '0'" in openmp_says(alone)
    said = openmp_says(alone, OMP_WAIT_POLICY="active")
    assert "OMP_WAIT_POLICY = 'ACTIVE'" in said
    said = openmp_says(alone, GOMP_SPINCOUNT="77")
    assert "GOMP_SPINCOUNT = '77'" in said


def test_nothing_is_set_once_torch_is_there(monkeypatch):
    """It would only reach the processes that this one starts."""
    for name in threads.WAITING:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setitem(sys.modules, "torch", sys)
    threads.let_waiting_threads_sleep()
    assert not any(name in os.environ for name in threads.WAITING)


def stat(path: Path, *idle: int) -> None:
    """A /proc/stat; `idle` in ticks, of which a fifth waits for a disk."""
    lines = ["cpu 1 2 3 4 5 6 7 8 9 10"]
    lines += [f"cpu{i} 9 0 9 {n - n // 5} {n // 5} 0 0 0 0 0" for i, n in enumerate(idle)]
    path.write_text("\n".join([*lines, "intr 5", ""]))


@pytest.mark.parametrize(
    ("idle", "free"),
    [
        ((0.0, 0.0, 0.0, 0.0), 1),
        ((1.0, 0.0, 0.0, 0.0), 1),
        ((1.0, 0.9, 0.0, 0.0), 2),
        ((0.6, 0.6, 0.6, 0.6), 2),
        ((1.0, 1.0, 1.0, 1.0), 4),
        ((1.0, 1.0, 1.0, 1.0, 1.0), 4),  # the fifth is not ours
    ],
)
def test_idle_time_is_what_is_free(tmp_path, monkeypatch, idle, free):
    path, clock = tmp_path / "stat", [100.0]
    ticks = os.sysconf("SC_CLK_TCK")

    def sleep(seconds):
        clock[0] += seconds
        stat(path, *(5000 + round(share * (clock[0] - 100) * ticks) for share in idle))

    stat(path, *(5000 for _ in idle))
    monkeypatch.setattr(threads, "_STAT", path)
    monkeypatch.setattr(threads, "WATCHED_S", 10.0)
    monkeypatch.setattr(threads, "cores", lambda: [0, 1, 2, 3])
    monkeypatch.setattr(threads.time, "sleep", sleep)
    monkeypatch.setattr(threads.time, "monotonic", lambda: clock[0])
    assert threads.free_cores() == free
    assert threads.number_of("auto") == free


@pytest.mark.parametrize("text", [None, "", "cpu0 1", "cpu0 1 2 3 x 5\ncpu1 1 2 3 4 5"])
def test_where_the_system_does_not_tell_the_load_is_taken_off(tmp_path, monkeypatch, text):
    monkeypatch.setattr(threads, "_STAT", tmp_path / "stat")
    if text is not None:
        (tmp_path / "stat").write_text(text)
    monkeypatch.setattr(threads, "cores", lambda: [0, 1])
    for load, free in ((0.1, 2), (1.2, 1), (7.0, 1)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert threads.free_cores() == free


@pytest.mark.skipif(not Path("/proc/stat").is_file(), reason="no /proc/stat")
def test_a_busy_machine_has_one_core_for_us():
    bound = "import os, sys; os.sched_setaffinity(0, [int(sys.argv[1])]); print(flush=True)"
    command = [sys.executable, "-c", f"{bound}\nwhile True: pass"]
    others = [
        subprocess.Popen([*command, str(core)], stdout=subprocess.PIPE) for core in threads.cores()
    ]
    try:
        for other in others:
            other.stdout.read(1)
        assert threads.free_cores() == 1
    finally:
        for other in others:
            other.kill()
            other.wait()
            other.stdout.close()


def test_numbers_as_they_are_given():
    assert threads.number_of(3) == 3
    assert threads.number_of(None) == len(threads.cores()) >= 1
    assert set(threads.cores()) <= set(range(os.cpu_count()))
