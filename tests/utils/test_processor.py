"""What a process takes of the machine: threads and how they wait, time, memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from qs3.utils import processor
from qs3.utils.processor import processor_seconds

ROOT = Path(__file__).parents[2]
BEGINNING = "from qs3.utils.commands import run; run({}, ['--version']); "
WORK = 0.2  # seconds
SLACK = 0.03  # the system counts in hundredths, of user and system apart
MEMORY = """
import resource, sys
import numpy as np
from qs3.utils.processor import keep_freed_memory

if sys.argv[1] == "kept":
    assert keep_freed_memory()
for _ in range(3):
    np.ones(8 << 20)  # 64 MB in some 16,000 pages
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    np.ones(8 << 20)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's")
def test_pages_of_what_is_freed_are_not_cleared_again() -> None:
    def faults(how: str) -> int:
        run = [sys.executable, "-c", MEMORY, how]
        return int(subprocess.run(run, capture_output=True, text=True, check=True).stdout)

    assert faults("kept") < 100
    assert faults("as ever") > 100  # else there is nothing to keep: the setting may go


def test_work_counts_and_waiting_does_not():
    before, begun = processor_seconds(), time.process_time()
    while time.process_time() - begun < WORK:
        pass
    assert processor_seconds() - before == pytest.approx(time.process_time() - begun, abs=SLACK)
    before, begun = processor_seconds(), time.process_time()
    time.sleep(WORK)
    assert processor_seconds() - before < time.process_time() - begun + SLACK
    before = processor_seconds()
    code = f"import time\nwhile time.process_time() < {WORK}: pass"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert processor_seconds() - before > WORK - SLACK


@pytest.mark.skipif(sys.platform != "linux", reason="torch brings another OpenMP elsewhere")
def test_openmps_threads_sleep_unless_the_environment_sets_it():
    (openmp,) = Path(find_spec("torch").origin).parent.glob("lib/libgomp*")
    alone = f"{BEGINNING}import ctypes; ctypes.CDLL({str(openmp)!r})"  # torch takes seconds
    kept = {name: value for name, value in os.environ.items() if name not in processor.WAITING}
    for given, said in (
        ({}, "GOMP_SPINCOUNT = '0'"),
        ({"OMP_WAIT_POLICY": "active"}, "OMP_WAIT_POLICY = 'ACTIVE'"),
        ({"GOMP_SPINCOUNT": "77"}, "GOMP_SPINCOUNT = '77'"),
    ):
        done = subprocess.run(
            [sys.executable, "-c", alone], env={**kept, "OMP_DISPLAY_ENV": "VERBOSE", **given},
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert said in done.stderr


def test_free_cores(monkeypatch):
    monkeypatch.setattr(processor, "cores", lambda: [0, 1])
    for load, free in ((0.1, 2), (1.2, 1), (7.0, 1)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert processor.free_cores() == free
