"""DGCNN without edges against the straight network, forward and backward, in one process."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F
from torch_geometric.nn import EdgeConv as PygEdgeConv

from qs3.geometry.neighbours import knn
from qs3.models.dgcnn import EdgeConv, dgcnn
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.models.reference import NaiveDGCNN


def _edges(index: torch.Tensor) -> torch.Tensor:
    """[2, b * n * k] from neighbours [b, n, k]: source and target of all edges of a batch."""
    b, n, k = index.shape
    offset = (torch.arange(b, device=index.device) * n)[:, None, None]
    target = (torch.arange(n, device=index.device)[None, :, None] + offset).expand(b, n, k)
    return torch.stack([(index + offset).reshape(-1), target.reshape(-1)])


def _step(model: nn.Module, points: torch.Tensor, labels: torch.Tensor) -> Callable[[], None]:
    def step() -> None:
        model.zero_grad()
        F.cross_entropy(model(points), labels).backward()
        finish()

    return step


def _fastest(step: Callable[[], None], rounds: int) -> float:
    """The least of the seconds that it takes."""
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        step()
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.parametrize(
    ("variant", "b", "n", "k"),
    [
        ("uda", 16, 1024, 20),
        ("simpleview", 16, 1024, 20),
        ("uda", 32, 256, 20),
        ("uda", 32, 256, 10),
    ],
)
def test_training_step(
    variant: str, b: int, n: int, k: int, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    torch.manual_seed(0)
    model = dgcnn(10, k=k, variant=variant).to(DEVICE)
    points, labels = torch.randn(b, n, 3).to(DEVICE) / 2, torch.randint(10, (b,)).to(DEVICE)
    step = _step(model, points, labels)
    benchmark.pedantic(step, rounds=4, warmup_rounds=1)
    if not benchmark.enabled:
        return
    some = 2 if DEVICE.type == "cpu" else b  # as many as memory likes; a GPU's batches are equal
    naive = _step(NaiveDGCNN(model), points[:some], labels[:some])
    naive()
    theirs = _fastest(naive, 4) / some  # as ours
    ours = benchmark.stats.stats.min / b
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nDGCNN {variant}, {b} x {n}, k {k}: {ours * 1e3:.1f} ms a cloud, "
            f"naive {theirs * 1e3:.1f}: {theirs / ours:.1f} times faster, "
            f"{WHERE}"
        )


@pytest.mark.parametrize(("c", "d"), [(3, 64), (64, 128), (128, 256)])
def test_layer_against_pyg(
    c: int, d: int, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    """One EdgeConv, forward and backward, on edges found beforehand."""
    torch.manual_seed(0)
    ours = EdgeConv(c, d).to(DEVICE)
    mlp = nn.Sequential(nn.Linear(2 * c, d, bias=False), nn.BatchNorm1d(d), nn.LeakyReLU(0.2))
    theirs = PygEdgeConv(mlp, aggr="max").to(DEVICE)
    x = torch.randn(2, 1024, c).to(DEVICE).requires_grad_()
    index = knn(x.detach(), 20)
    pairs = _edges(index)

    def step() -> None:
        ours(x, index).sum().backward()
        finish()

    benchmark.pedantic(step, rounds=4, warmup_rounds=1)

    def pyg_step() -> None:
        theirs(x.flatten(0, 1), pairs).sum().backward()
        finish()

    fastest = _fastest(pyg_step, 3 if benchmark.enabled else 1)
    if not benchmark.enabled:
        return
    ratio = fastest / benchmark.stats.stats.min
    benchmark.extra_info["times_faster"] = ratio
    with capsys.disabled():
        print(f"\nEdgeConv {c} -> {d}: {ratio:.1f} times faster than PyG's")  # noqa: T201
