"""The time of a run is that of all its starts."""

from __future__ import annotations

import json

import torch

from qs3.config import hashing
from qs3.runs.checkpoints import load
from qs3.training.command import train
from qs3.utils.files import sha256_file
from tests.training.conftest import toy, toy_data  # noqa: F401 (fixtures)
from tests.training.watching import interrupt

LONG = 1e6  # seconds; no test takes as long


def wind_forward(checkpoint):
    """As if the run had taken `LONG` until then."""
    content = load(checkpoint)
    content["callbacks"]["Clock"]["seconds"] += LONG
    torch.save(content, checkpoint)


def test_earlier_starts_count(toy):  # noqa: F811
    cfg = toy("selftraining=none")
    interrupt(cfg, "on_train_epoch_start", 3)
    wind_forward(hashing.run_folder(cfg) / "last.ckpt")
    assert LONG < train(cfg).times.seconds < 2 * LONG


def test_a_shared_warmup_counts(toy, tmp_path):  # noqa: F811
    assert 0 < train(toy("selftraining=none")).times.seconds < LONG
    (shared,) = (tmp_path / "logs" / "warmups").rglob("*.ckpt")
    wind_forward(shared)
    mark = shared.with_name("started.json")  # as if it had been written so
    content = json.loads(mark.read_text())
    content["files"]["last.ckpt"] = sha256_file(shared)
    mark.write_text(json.dumps(content))
    assert LONG < train(toy()).times.seconds < 2 * LONG
