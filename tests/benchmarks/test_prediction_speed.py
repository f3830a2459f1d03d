"""Clouds a second of `qs3.inference`, files to probabilities, against the straight way."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.inference.inputs import cloud_units
from qs3.inference.model_file import Result
from qs3.inference.predictor import Predictor
from qs3.inference.settings import Settings
from qs3.inference.units import predict_units
from qs3.models.dgcnn import dgcnn
from tests.models.reference import NaiveDGCNN

CLASSES = tuple("abcdefghij")


def _straight_fps(cloud: np.ndarray, count: int) -> np.ndarray:
    """Farthest points as in the lineage's numpy loops."""
    chosen = np.zeros(count, dtype=int)
    nearest = np.full(len(cloud), np.inf)
    for i in range(1, count):
        nearest = np.minimum(nearest, ((cloud - cloud[chosen[i - 1]]) ** 2).sum(1))
        chosen[i] = nearest.argmax()
    return cloud[chosen]


def _straight(files: list[Path], net: NaiveDGCNN) -> np.ndarray:
    found = []
    for path in files:
        cloud = np.loadtxt(path)
        cloud = cloud - cloud.mean(0)
        cloud = _straight_fps(cloud / np.linalg.norm(cloud, axis=1).max(), 1024)
        with torch.no_grad():
            logits = net(torch.from_numpy(cloud).float()[None])
        found.append(logits.softmax(1)[0].numpy())
    return np.stack(found)


@pytest.mark.parametrize("suffix", [".xyz", ".npy"])
def test_clouds_a_second(
    suffix: str, tmp_path: Path, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    net = dgcnn(len(CLASSES)).eval()
    count = 64 if benchmark.enabled else 2
    files = []
    for i in range(count):
        cloud = rng.normal(size=(2048, 3)).astype(np.float32)
        files.append(tmp_path / f"{i:03d}{suffix}")
        if suffix == ".npy":
            np.save(files[-1], cloud)
        else:
            np.savetxt(files[-1], cloud, fmt="%.6f")
    usual = {name: [0.0, 1e9] for name in ("points", "spacing", "middle", "thickness", "height")}
    result = Result({}, CLASSES, 1024, 2048, "made", "z", "unit_ball", usual, {})
    predictor = Predictor(net, result, torch.device("cpu"))
    threads = torch.get_num_threads()
    settings = Settings(ckpt="", input="clouds", threads=threads)

    def run() -> np.ndarray:
        rows = list(predict_units(predictor, cloud_units(files, tmp_path, "z", ()), settings))
        return np.stack([row.probabilities for row, _ in rows if row.probabilities is not None])

    straight = NaiveDGCNN(net).eval()
    seconds, theirs = 0.0, np.empty((0, len(CLASSES)))
    if suffix == ".xyz":
        few = files[:8] if benchmark.enabled else files[:1]
        _straight(few[:1], straight)
        begin = time.perf_counter()
        theirs = _straight(few, straight)
        seconds = (time.perf_counter() - begin) / len(few)
    found = benchmark.pedantic(run, rounds=3, warmup_rounds=1 if benchmark.enabled else 0)
    # the straight way is in float64, so a tie in sampling may fall otherwise: not closer than this
    np.testing.assert_allclose(found[: len(theirs)], theirs, atol=1e-3)
    if not benchmark.enabled:
        return
    ours = benchmark.stats.stats.min / count
    text = f"\npredict, {suffix}, DGCNN 1,024 of 2,048 points: {1 / ours:.1f} clouds a second"
    benchmark.extra_info["clouds_a_second"] = 1 / ours
    if suffix == ".xyz":
        benchmark.extra_info["times_faster"] = seconds / ours
        text += f", straight {1 / seconds:.1f}: {seconds / ours:.1f} times faster"
    with capsys.disabled():
        print(f"{text}, {threads} threads")  # noqa: T201
