"""Benchmarks run as trainings do: deterministic on the CPU, not on a GPU, where it costs."""

from collections.abc import Iterator

import pytest

from qs3.utils.processor import let_waiting_threads_sleep
from tests.benchmarks.timing import DEVICE, ENABLED, THREADS

if ENABLED:
    let_waiting_threads_sleep()

import torch

from qs3.training.fit import settle_process


@pytest.fixture(autouse=True, scope="session")
def as_trainings_do() -> Iterator[None]:
    if ENABLED:
        settle_process(THREADS)
        torch.use_deterministic_algorithms(DEVICE.type == "cpu")
    yield
    torch.use_deterministic_algorithms(False)
