"""Where benchmarks run: `make bench DEVICE=cuda`, for nets and methods, or `THREADS=1`."""

from __future__ import annotations

import os

import torch

from qs3.utils.threads import cores

THREADS = int(os.environ.get("QS3_BENCH_THREADS") or len(cores()))  # as a training takes them
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
