"""Multiruns of train.py's light twin."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from tests.running import command


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
