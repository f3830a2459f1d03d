"""The commands: `qs3 WORDS` in this process, `python train.py WORDS` in one of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from qs3.__main__ import COMMANDS
from qs3.utils.commands import run

ROOT = Path(__file__).parents[1]


def main(argv: Sequence[str]) -> int:
    return run(COMMANDS, argv)


def command(
    folder: Path, *arguments: str, script: str = "train.py", **environment: str
) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(ROOT / script), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
    )
