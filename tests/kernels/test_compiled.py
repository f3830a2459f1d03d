from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.kernels import compiled


def edges(points: int, rows: int, k: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(points, (rows, k), generator=torch.Generator().manual_seed(seed))


@settings(max_examples=40, deadline=None)
@given(
    points=st.integers(1, 9),
    rows=st.integers(0, 9),
    k=st.integers(1, 5),
    channels=st.integers(1, 20),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 99),
)
def test_maxima_and_who_has_them_first(points, rows, k, channels, dtype, seed):
    torch.manual_seed(seed)
    x = torch.randint(3, (points, channels)).to(dtype)  # with many that are equal
    x[torch.rand(x.shape) < 0.05] = torch.nan
    index = edges(points, rows, k, seed)
    best, where = compiled.neighbour_max(x, index)
    for i in range(rows):
        for c in range(channels):
            values = x[index[i], c].numpy()
            first = int(np.argmax(values))  # numpy's, too, takes the first, and NaN before all
            assert np.array_equal(best[i, c].numpy(), values[first], equal_nan=True)
            if not np.isnan(values[first]):
                assert where[i, c] == index[i, first]


@settings(max_examples=100, deadline=None)
@given(data=st.data(), width=st.sampled_from([32, 64]), rows=st.integers(0, 3))
def test_the_kth_smallest_is_that_of_sorted_rows(data, width, rows):
    kind = np.dtype(f"float{width}").type
    tiny, huge = np.finfo(kind).smallest_subnormal, np.finfo(kind).max
    some = st.sampled_from([0.0, -0.0, np.nan, -np.nan, np.inf, -np.inf, tiny, -tiny, huge, -huge])
    number = st.one_of(some, st.floats(width=width), st.integers(-2, 2))
    groups = data.draw(st.integers(1, 9))
    row = st.lists(number, min_size=groups, max_size=groups)
    drawn = data.draw(st.lists(row, min_size=rows, max_size=rows))
    x = np.array(drawn, dtype=kind).reshape(rows, groups)
    k = data.draw(st.integers(1, groups))
    found = compiled._kth_smallest(torch.from_numpy(x), k).numpy()
    np.testing.assert_array_equal(found, np.sort(x, axis=1)[:, k - 1])


def test_threads_move_no_bit(monkeypatch):
    torch.manual_seed(0)
    x, index = torch.randn(500, 64), edges(500, 4000, 20)
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        best, where = compiled.neighbour_max(x, index)
        back = compiled.neighbour_max_backward(best, where, 500)
        results.append((best, where, back, compiled.add_to_neighbours(best, index % 4000)))
    for others in results[1:]:
        assert all(map(torch.equal, results[0], others))


@pytest.mark.parametrize(("rows", "k", "among"), [(1, 1, 1), (50, 4, 50), (40, 20, 3)])
def test_rows_are_added_to_those_that_they_name(rows, k, among):
    """By a loop; with rows that nobody names, and some that one row names several times."""
    index = edges(among, rows, k)
    x = torch.randn(rows, 5, dtype=torch.float64)
    expected = torch.zeros_like(x)
    for i in range(rows):
        for j in index[i].tolist():
            expected[j] += x[i]
    torch.testing.assert_close(compiled.add_to_neighbours(x, index), expected)
