"""The version, where a module that writes it down need not import the whole face of qs3."""

import os
import subprocess
from functools import cache
from pathlib import Path

VERSION = "0.1.0"

_CHECKOUT = Path(__file__).resolve().parents[2]


@cache
def commit() -> str:
    """The checkout's commit, with "+" where files differ from it; "" of an installed qs3."""
    if not (_CHECKOUT / ".git").exists():
        return ""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    command = ["git", "--no-optional-locks", "describe", "--always", "--exclude=*"]
    command += ["--abbrev=12", "--dirty=+"]
    try:
        done = subprocess.run(
            command, cwd=_CHECKOUT, env=environment, capture_output=True, text=True, check=True,
            timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):  # no git, or it may not read what is another's
        return ""
    return done.stdout.strip()
