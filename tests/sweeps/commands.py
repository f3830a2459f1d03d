"""Runs the two commands of the tests: train.py on tiny data, and its light twin."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def command(folder: Path, *arguments: str, script: str = "train.py") -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(ROOT / script), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def light(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    """A multirun of `light_train.py`, its logs in `folder`/logs."""
    script = "tests/sweeps/light_train.py"
    return command(folder, "experiment=qs3_s2d", *arguments, "--multirun", script=script)


def light_runs(folder: Path) -> dict[str, dict]:
    """What the light runs noted, by the name of their folder."""
    return {
        path.parent.name: json.loads(path.read_text())
        for path in sorted(folder.glob("logs/*/*/light.json"))
    }
