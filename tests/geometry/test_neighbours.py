from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry.neighbours import farthest_point_sampling, knn
from qs3.kernels import compiled
from tests.device import as_on_device
from tests.geometry.test_sampling import assert_farthest


def _distances(x: torch.Tensor) -> torch.Tensor:
    return (x[:, :, None] - x[:, None]).square().sum(-1)


def _assert_nearest(x: torch.Tensor, index: torch.Tensor, atol: float = 1e-9) -> None:
    """Distances are the k smallest, in order; the points are distinct. Leaves ties open."""
    distance = _distances(x)
    k = index.shape[2]
    expected = distance.sort(dim=2)[0][:, :, :k]
    torch.testing.assert_close(distance.gather(2, index), expected, rtol=1e-6, atol=atol)
    assert (index.sort(dim=2)[0].diff(dim=2) > 0).all()


@pytest.mark.parametrize("equal", [0, 1, 60, 200])
def test_smallest_sums_of_rows_that_are_mostly_equal(equal: int) -> None:
    """Of `equal` columns that share the least value the first come first."""
    torch.manual_seed(0)
    values, more = torch.rand(6, 203), torch.rand(3, 203)
    values[:, 3 : 3 + equal] = -9 - more.repeat_interleave(2, 0)[:, 3 : 3 + equal]
    sums = values + more.repeat_interleave(2, 0)
    found = compiled.smallest_sums(values, more, 20)
    assert torch.equal(values, sums)
    assert torch.equal(sums.gather(1, found), sums.sort(1)[0][:, :20])
    assert torch.equal(found, sums.sort(dim=1, stable=True)[1][:, :20])


def test_knn_with_k_above_n_starts_over() -> None:
    x = torch.tensor([[[0.0], [1.0], [5.0]]])
    assert knn(x, 5).tolist() == [[[0, 1, 2, 0, 1], [1, 0, 2, 1, 0], [2, 1, 0, 2, 1]]]


def test_knn_far_from_origin_and_in_half_precision() -> None:
    x = torch.randn(1, 256, 3)
    expected = _distances(x.double()).topk(4, largest=False)[1]
    far = knn(x.double() + 1e4, 4)
    assert torch.equal(far, expected)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(knn(x, 4), expected)
    assert knn(x.bfloat16(), 4).shape == (1, 256, 4)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 260), st.integers(1, 33), st.integers(0, 10_000), st.booleans())
def test_knn_of_anything(n: int, k: int, seed: int, grid: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    if grid:
        x = x.round()  # many ties and copies
    k = min(k, n)
    index = knn(x, k)
    _assert_nearest(x, index)
    if not grid:
        assert torch.equal(index[:, :, 0], torch.arange(n).expand(2, n))  # itself
        order = torch.randperm(n, generator=generator)
        assert torch.equal(order[knn(x[:, order], k)], index[:, order])  # equivariant


def _on_device(*args: Any) -> torch.Tensor:
    with as_on_device():
        return farthest_point_sampling(*args)


@pytest.mark.parametrize("sample", [farthest_point_sampling, _on_device])
def test_fps_batched(sample: object) -> None:
    torch.manual_seed(0)
    x = torch.randn(3, 120, 3)
    start = torch.tensor([5, 0, 119])
    order = sample(x, 60, start)
    assert torch.equal(order[:, 0], start)
    for cloud, row in zip(x, order, strict=True):
        assert len(set(row.tolist())) == 60
        assert_farthest(cloud.double().numpy(), row.numpy())
    repeated = sample(x, 250)
    assert torch.equal(repeated[:, 120:240], repeated[:, :120])
    assert torch.equal(repeated[:, 240:], repeated[:, :10])
    copies = sample(torch.ones(2, 6, 3), 6, 2)
    assert copies[:, 0].tolist() == [2, 2]
    assert torch.equal(copies.sort(1)[0], torch.arange(6).expand(2, 6))
