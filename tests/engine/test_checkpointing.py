"""The time of a run is that of all its starts."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from qs3.config.hydra import run_folder
from qs3.engine import checkpointing
from qs3.engine.checkpointing import AtomicCheckpointIO, Clock
from qs3.runs.checkpoints import load
from qs3.training.command import train
from qs3.utils.processor import Moment
from tests.training.watching import interrupt

GB = 1_000_000_000
LONG = 1e6  # seconds; no test takes as long


def wind_forward(checkpoint):
    """As if the run had taken `LONG` until then."""
    content = load(checkpoint)
    content["callbacks"]["Clock"]["seconds"] += LONG
    content["callbacks"]["Clock"]["core_seconds"] += LONG
    torch.save(content, checkpoint)


def test_earlier_starts_count(toy):
    cfg = toy("selftraining=none")
    interrupt(cfg, "on_train_epoch_start", 3)
    wind_forward(run_folder(cfg) / "last.ckpt")
    times = train(cfg).times
    assert LONG < times.seconds < 2 * LONG
    assert LONG < times.core_seconds < 2 * LONG


@pytest.fixture
def meters(monkeypatch):
    """The clock's time, and what process and GPU have had at most, as a test sets them."""
    found = {"time": 100.0, "cores": 20.0, "memory": 0, "gpu": None}
    monkeypatch.setattr(checkpointing, "processor_seconds", lambda: found["cores"])
    monkeypatch.setattr(checkpointing.time, "time", lambda: found["time"])
    usage = lambda _: SimpleNamespace(ru_maxrss=found["memory"] / 1024)  # noqa: E731
    monkeypatch.setattr(checkpointing.resource, "getrusage", usage)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: found["gpu"] is not None)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: found["gpu"])
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda: None)
    return found


def test_a_clock_says_seconds_and_gigabytes(meters):
    clock = Clock(Moment(wall=90.0, cores=18.0))
    first = {"seconds": 10.0, "core_seconds": 2.0, "memory": 0, "gpu": 0}
    assert clock.state_dict() == first
    taken = clock.taken()
    assert (taken.seconds, taken.memory_gb, taken.gpu_memory_gb) == (10.0, None, None)
    meters |= {
        "time": 102.34,
        "cores": 43.21,
        "memory": 1_500_500_000_000 // 1000,
        "gpu": 2_250_000,
    }
    taken = clock.taken()
    assert (taken.seconds, taken.memory_gb, taken.gpu_memory_gb) == (12.3, 1.5, 0.002)
    assert taken.core_seconds == 25.2
    meters |= {"memory": 1234 * 10**9 + 1_500_600}  # where a billion and one would be another
    assert clock.taken().memory_gb == 1234.002


def test_a_clock_goes_on_with_the_greater_peak_and_both_times(meters):
    meters |= {"memory": 2 * GB, "gpu": GB}
    clock = Clock(Moment(wall=100.0, cores=20.0))
    peaks = {"memory": 3 * GB, "gpu": GB // 2}
    clock.load_state_dict({"seconds": 50, "core_seconds": 70.0, **peaks})
    meters |= {"time": 101.0, "cores": 22.0}
    times = {"seconds": 51.0, "core_seconds": 72.0}
    assert clock.state_dict() == {**times, "memory": 3 * GB, "gpu": GB}
    meters |= {"memory": 0, "gpu": None}
    assert clock.state_dict() == {**times, **peaks}


def test_a_checkpoint_goes_where_it_is_asked_for(tmp_path):
    files, path = AtomicCheckpointIO(), tmp_path / "a.ckpt"
    files.save_checkpoint({"pytorch-lightning_version": "2", "x": torch.ones(2)}, path)
    assert files.load_checkpoint(path)["x"].device.type == "cpu"
    assert files.load_checkpoint(path, map_location="meta")["x"].device.type == "meta"
    files.remove_checkpoint(path)
    assert not path.exists()
    files.remove_checkpoint(path)  # another process may have been quicker
