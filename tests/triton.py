"""Kernels written in Triton, in its interpreter: no GPU is needed, Triton is."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

needs_triton = pytest.mark.skipif(
    find_spec("triton") is None,
    reason="Triton is missing: `make test-triton` fetches it",
)


def in_interpreter(program: str) -> list[str]:
    """The words that a Python program printed, in a process of its own.

    Triton asks for its interpreter when it is first imported.
    """
    found = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return found.stdout.split()
