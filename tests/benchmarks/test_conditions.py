"""Under which conditions benchmarks run: as trainings do, and on a device only what is of it."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Literal

import pytest
import torch
from lightning.pytorch import Trainer
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.device import DEVICE, THREADS, deterministic

HERE = Path(__file__).parent
MODULES = sorted(path.stem for path in HERE.glob("test_*.py"))


def test_benchmarks_run_as_trainings_do(benchmark: BenchmarkFixture) -> None:
    """With tensors left unfilled, and deterministic; `make test-all` leaves its process alone."""
    benchmark.pedantic(lambda: None)
    if benchmark.enabled:
        assert not torch.utils.deterministic.fill_uninitialized_memory
        assert torch.are_deterministic_algorithms_enabled() is (DEVICE.type == "cpu")
        assert torch.get_num_threads() == THREADS


def _determinism() -> tuple[int, str | None]:
    return torch.get_deterministic_debug_mode(), os.environ.get("CUBLAS_WORKSPACE_CONFIG")


@pytest.mark.parametrize("setting", [False, "warn", True])
def test_determinism_is_as_the_trainer_sets_it(setting: bool | Literal["warn"]) -> None:
    before = _determinism()
    with deterministic(setting):
        ours = _determinism()
    assert _determinism() == before
    with deterministic(not setting):  # gives back what the trainer sets
        os.environ.pop("CUBLAS_WORKSPACE_CONFIG", None)
        Trainer(deterministic=setting, logger=False, enable_checkpointing=False)
        assert _determinism() == ours
    assert _determinism() == before


def _names(code: CodeType) -> Iterator[str]:
    """What a function names, and the functions within it."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names(inner)


def _reached(module: ModuleType, name: str, seen: set[str]) -> set[str]:
    """Names that a function of a module reaches by way of others of that module."""
    call = getattr(module, name, None)
    if name not in seen:
        seen.add(name)
        if isinstance(call, FunctionType) and call.__module__ == module.__name__:
            for other in _names(call.__code__):
                _reached(module, other, seen)
    return seen


@pytest.mark.parametrize("name", MODULES)
def test_a_file_that_takes_the_device_takes_it_in_each_test(name: str) -> None:
    """Only files without `DEVICE` are left out on another device than the CPU."""
    module = importlib.import_module(f"tests.benchmarks.{name}")
    if not hasattr(module, "DEVICE") or name == Path(__file__).stem:
        return
    tests = [key for key in vars(module) if key.startswith("test_")]
    assert tests
    assert [key for key in tests if "DEVICE" not in _reached(module, key, set())] == []


def test_what_is_of_the_cpu_is_left_out_on_another_device() -> None:
    """On torch's device without values, as no other is everywhere."""
    of_the_cpu = [str(HERE / f"test_{name}.py") for name in ("share_of_peak", "numba_speed")]
    asked = [*of_the_cpu, f"{__file__}::{test_benchmarks_run_as_trainings_do.__name__}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", "-m", "", *asked],
        cwd=HERE.parents[1],
        env=os.environ | {"QS3_BENCH_DEVICE": "meta"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed, 5 skipped" in done.stdout
    assert done.stdout.count(": is of the CPU") == len(of_the_cpu)  # a line a file
