"""Benchmarks run as trainings do."""

from collections.abc import Iterator

import pytest

from qs3.utils.threads import let_waiting_threads_sleep
from tests.benchmarks.timing import DEVICE, ENABLED, THREADS, deterministic

if ENABLED:
    let_waiting_threads_sleep()

import torch

from qs3.engine.trainer import settle_process


@pytest.fixture(autouse=True)
def as_trainings_do() -> Iterator[None]:
    """As `trainer=cpu` has it; on a GPU, where `trainer.deterministic` costs, without it."""
    if not ENABLED:
        yield
        return
    filled = torch.utils.deterministic.fill_uninitialized_memory
    threads = torch.get_num_threads()
    settle_process(THREADS)
    try:
        with deterministic(DEVICE.type == "cpu"):
            yield
    finally:
        torch.utils.deterministic.fill_uninitialized_memory = filled
        torch.set_num_threads(threads)
