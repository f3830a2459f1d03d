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
BEGINNING = "from qs3.utils.commands import run; run({}, ['--version']); "


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


def test_the_load_is_taken_off(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: [0, 1])
    for load, free in ((0.1, 2), (1.2, 1), (7.0, 1)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert threads.number_of("auto") == free


def test_numbers_as_they_are_given():
    assert threads.number_of(3) == 3
    assert threads.number_of(None) == len(threads.cores()) >= 1
    assert set(threads.cores()) <= set(range(os.cpu_count()))
