"""Processor time of a process and of its ended children."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from qs3.utils.processor_time import processor_seconds

WORK = 0.2  # seconds
SLACK = 0.03  # the system counts in hundredths, of user and system apart


def test_work_counts_and_waiting_does_not():
    before, begun = processor_seconds(), time.process_time()
    while time.process_time() - begun < WORK:
        pass
    assert processor_seconds() - before == pytest.approx(time.process_time() - begun, abs=SLACK)
    before, begun = processor_seconds(), time.process_time()
    time.sleep(WORK)
    assert processor_seconds() - before < time.process_time() - begun + SLACK


def test_children_count_when_they_have_ended():
    before = processor_seconds()
    code = f"import time\nwhile time.process_time() < {WORK}: pass"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert processor_seconds() - before > WORK - SLACK
