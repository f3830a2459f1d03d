"""Nothing is lost and nothing foreign is said at any point where a command touches the disk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = 4  # each tries a quarter of the points


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("how", ["kill", "fail"])
@pytest.mark.parametrize("name", ["generation", "training"])
def test_every_point_may_be_the_last(name, how, part):
    words = [sys.executable, "-W", "ignore", "-m", "tests.faults", name, how, str(part), str(PARTS)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    said = json.loads(done.stdout.splitlines()[-1])
    print(name, how, said)  # noqa: T201
    assert said["wrong"] == []
    assert said["foreign"] == 0
    assert said["points"] > 60
    assert said["tried"] >= said["points"] // PARTS
    assert how != "kill" or said["killed"] == said["tried"]
