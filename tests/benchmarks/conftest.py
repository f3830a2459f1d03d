"""Benchmarks run as trainings do; on another device than the CPU only those that take it run."""

import sys
from collections.abc import Iterator

import pytest

from qs3.utils.threads import let_waiting_threads_sleep

if "--benchmark-enable" in sys.argv:  # before torch is loaded
    let_waiting_threads_sleep()

import torch

from qs3.engine.trainer import settle_process
from tests.benchmarks.device import DEVICE, THREADS, deterministic


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        module = getattr(item, "module", None)
        here = module is not None and module.__name__.startswith("tests.benchmarks.")
        if DEVICE.type != "cpu" and here and not hasattr(module, "DEVICE"):
            item.add_marker(pytest.mark.skip(reason="is of the CPU"))


@pytest.fixture(autouse=True)
def as_trainings_do(request: pytest.FixtureRequest) -> Iterator[None]:
    """As `trainer=cpu` has it; on a GPU, where `trainer.deterministic` costs, without it."""
    if not request.config.getoption("benchmark_enable"):
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
