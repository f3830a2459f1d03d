"""Where benchmarks of nets and methods run: `make bench DEVICE=cuda`. Nothing else changes."""

from __future__ import annotations

import os

import torch

DEVICE = torch.device(os.environ.get("QS3_BENCH_DEVICE") or "cpu")
WHERE = (
    f"{torch.get_num_threads()} threads"
    if DEVICE.type == "cpu"
    else torch.cuda.get_device_name(DEVICE)
    if DEVICE.type == "cuda"
    else DEVICE.type
)


def finish() -> None:
    """Wait for what the device was asked for."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
