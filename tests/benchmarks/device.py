"""Where benchmarks run: `make bench DEVICE=cuda`, for nets and methods, or `THREADS=1`.

And of how many points the clouds of the methods' steps are: `POINTS=512`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch

from qs3.utils.threads import cores

THREADS = int(os.environ.get("QS3_BENCH_THREADS") or len(cores()))  # as a training takes them
POINTS = int(os.environ.get("QS3_BENCH_POINTS") or 1024)
DEVICE = torch.device(os.environ.get("QS3_BENCH_DEVICE") or "cpu")
WHERE = (
    f"{THREADS} threads"
    if DEVICE.type == "cpu"
    else torch.cuda.get_device_name(DEVICE)
    if DEVICE.type == "cuda"
    else DEVICE.type
)


def finish() -> None:
    """Wait for what the device was asked for."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)


@contextmanager
def deterministic(setting: bool | Literal["warn"]) -> Iterator[None]:
    """Inside, torch is as Lightning's trainer sets it by `trainer.deterministic`."""
    name = "CUBLAS_WORKSPACE_CONFIG"
    before = torch.get_deterministic_debug_mode(), os.environ.get(name)
    torch.use_deterministic_algorithms(bool(setting), warn_only=setting == "warn")
    os.environ.pop(name, None)  # of a training in this process
    if setting:
        os.environ[name] = ":4096:8"
    try:
        with warnings.catch_warnings():  # which operation has no deterministic form
            warnings.filterwarnings("ignore", message=".*deterministic", category=UserWarning)
            yield
    finally:
        torch.set_deterministic_debug_mode(before[0])
        os.environ.pop(name, None)
        if before[1] is not None:
            os.environ[name] = before[1]
