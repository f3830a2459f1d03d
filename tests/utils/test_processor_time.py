"""Processor time of a process and of all below it, alive or ended."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from qs3.utils import processor_time
from qs3.utils.processor_time import processor_seconds

WORK = 0.2  # seconds
SLACK = 0.03  # the system counts in hundredths, of user and system apart
BURN = f"""
import sys, time
while time.process_time() < {WORK}: pass
print(flush=True)
sys.stdin.read()
"""
ABOVE = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {BURN!r}], stdin=subprocess.PIPE)
sys.stdin.read()
child.communicate()
"""


def test_it_is_this_process_s_own() -> None:
    before, begun = processor_seconds(), time.process_time()
    while time.process_time() - begun < WORK:
        pass
    worked = time.process_time() - begun
    assert processor_seconds() - before == pytest.approx(worked, abs=SLACK)
    waiting, begun = processor_seconds(), time.process_time()
    time.sleep(WORK)
    assert processor_seconds() - waiting < time.process_time() - begun + SLACK


@pytest.mark.skipif(sys.platform != "linux", reason="the system does not list processes")
@pytest.mark.parametrize("program", [BURN, ABOVE], ids=["child", "child of a child"])
def test_processes_below_count_while_they_live_and_afterwards(program: str) -> None:
    before = processor_seconds()
    child = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdout is not None
    child.stdout.readline()  # the work is done
    alive = processor_seconds()
    child.communicate()
    ended = processor_seconds()
    assert alive - before > WORK - SLACK
    assert ended >= alive - SLACK


def test_a_process_that_is_not_there_counts_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(processor_time, "_PROCESSES", tmp_path)
    assert processor_time._of_process(1) == 0.0
    (tmp_path / "1" / "task" / "1").mkdir(parents=True)
    (tmp_path / "1" / "task" / "1" / "children").write_text("")
    fields = ["S", *["0"] * 10, "100", "200", "30", "4", "0"]
    (tmp_path / "1" / "stat").write_text(f"1 (a) b ({' '.join(fields)}) {' '.join(fields)}")
    assert processor_time._of_process(1) == pytest.approx(334 / processor_time._TICKS)
