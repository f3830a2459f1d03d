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
    try:
        head = _git("rev-parse", "--short=12", "HEAD")
        return head + "+" * bool(_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):  # no git, or it may not read what is another's
        return ""


def _git(*words: str) -> str:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    done = subprocess.run(
        ["git", "--no-optional-locks", *words],
        cwd=_CHECKOUT, env=environment, capture_output=True, text=True, check=True, timeout=10,
    )  # fmt: skip
    return done.stdout.strip()
