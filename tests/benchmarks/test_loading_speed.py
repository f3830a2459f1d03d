"""Our loader against the released way of loading, in one process: clouds a second.

The released way, per item (QS3's and GAST's data sets): parse a text file of 2,048 points, unit
ball, farthest point sampling to 1,024 in a numpy loop from a random start, a random turn about z,
jitter; then the items are stacked to a batch.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.augment import Augment
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_cache import prepare
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datamodules.splits import Labelled
from qs3.datasets.domain import Domain

CLOUDS, STORED, POINTS, BATCH = 4183, 2048, 1024, 16  # PointDA-10's ModelNet, QS3's warm-up
TEXT_FILES = 32


def released_item(path: Path, rng: np.random.Generator) -> np.ndarray:
    """One augmented cloud [1024, 3], the released way."""
    points = np.loadtxt(path).astype(np.float32)
    points = points - points.mean(axis=0)
    points = points / np.max(np.sqrt(np.sum(points**2, axis=1)))
    chosen = np.zeros(POINTS, dtype=np.int64)
    distance = np.full(len(points), 1e10)
    farthest = rng.integers(len(points))
    for i in range(POINTS):
        chosen[i] = farthest
        distance = np.minimum(distance, np.sum((points - points[farthest]) ** 2, axis=1))
        farthest = int(np.argmax(distance))
    points = points[chosen]
    angle = rng.uniform() * 2 * np.pi
    cos, sin = np.cos(angle), np.sin(angle)
    points = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    noise = np.clip(0.01 * rng.standard_normal(points.shape), -0.02, 0.02)
    return (points + noise).astype(np.float32)


def our_data(clouds: Clouds) -> AdaptationData:
    """The datamodule of a run, all whose clouds train."""
    ids = tuple(f"{i:05d}" for i in range(len(clouds)))
    labelled = Labelled(clouds, ids, torch.arange(len(clouds)) % 10)
    domain = Domain("made", "M", "Made", "nowhere")
    data = AdaptationData(
        domain,
        domain,
        phases=Phases(200),
        scheme=SelfTrainingConfig(),
        augment=Augment(),
        batch_size=BATCH,
        seed=0,
    )
    data.labelled_domain.train = labelled
    data.trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    data.trainer.training = True
    return data


def epoch(data: AdaptationData) -> int:
    """All batches of one epoch, augmented; how many clouds they hold."""
    seen = 0
    for batch in data.train_dataloader():
        points = data.on_after_batch_transfer(batch, 0)["source"]["points"]
        assert points.shape[1:] == (POINTS, 3)
        seen += len(points)
    return seen


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # Lightning's on trainers without a loader
def test_an_epoch(
    benchmark: BenchmarkFixture, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    clouds = CLOUDS if benchmark.enabled else 32
    rng = np.random.default_rng(0)
    stored = rng.normal(size=(clouds, STORED, 3)).astype(np.float32)
    np.save(tmp_path / "points.npy", stored)
    mapped = np.load(tmp_path / "points.npy", mmap_mode="r")
    began = time.perf_counter()
    prepared = prepare(mapped, POINTS, starts=4, cache_dir=tmp_path, key="benchmark")
    sampling = time.perf_counter() - began
    began = time.perf_counter()
    prepared = prepare(mapped, POINTS, starts=4, cache_dir=tmp_path, key="benchmark")
    opening = time.perf_counter() - began
    data = our_data(prepared)

    rounds = 5 if benchmark.enabled else 1
    assert benchmark.pedantic(epoch, args=(data,), rounds=rounds, warmup_rounds=1) == clouds
    paths = [tmp_path / f"{i}.xyz" for i in range(TEXT_FILES if benchmark.enabled else 1)]
    for path, cloud in zip(paths, stored, strict=False):
        np.savetxt(path, cloud, fmt="%.6f")
    theirs = []
    for _ in range(3 if benchmark.enabled else 1):
        began = time.perf_counter()
        for i in range(0, len(paths), BATCH):
            items = [released_item(path, rng) for path in paths[i : i + BATCH]]
            batch = torch.from_numpy(np.stack(items))
            assert batch.shape[1:] == (POINTS, 3)
        theirs.append((time.perf_counter() - began) / len(paths))
    if not benchmark.enabled:
        return
    ours = benchmark.stats.stats.min / clouds
    benchmark.extra_info["clouds_per_s"] = 1 / ours
    benchmark.extra_info["times_faster"] = min(theirs) / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nloading {clouds} clouds of {POINTS} points, augmented: {ours * clouds:.2f} s an "
            f"epoch, {1 / ours:.0f} clouds/s; the released way {1 / min(theirs):.1f} clouds/s: "
            f"{min(theirs) / ours:.0f} times faster, {torch.get_num_threads()} threads. "
            f"Once: {sampling:.1f} s to sample from 4 starts, then {opening:.2f} s to open"
        )
    assert min(theirs) / ours > 100
