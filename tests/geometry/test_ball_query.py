import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry import ball_query as module
from qs3.geometry.ball_query import ball_query


def brute(x: torch.Tensor, c: torch.Tensor, radius: float, count: int) -> list[list[list[int]]]:
    result = []
    for cloud, centres in zip(x.tolist(), c.tolist(), strict=True):
        rows = []
        for centre in centres:
            d = [sum((a - b) ** 2 for a, b in zip(p, centre, strict=True)) for p in cloud]
            inside = [j for j, square in enumerate(d) if square < radius * radius][:count]
            if not inside:
                inside = [d.index(min(d))]
            rows.append(inside + inside[:1] * (count - len(inside)))
        result.append(rows)
    return result


def test_by_hand() -> None:
    x = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0], [3, 0, 0], [0.9, 0, 0]]])
    assert ball_query(x, x[:, :1], 1.0, 3).tolist() == [[[0, 2, 4]]]  # 1.0 itself is outside
    assert ball_query(x, x[:, :1], 1.0, 2).tolist() == [[[0, 2]]]  # by index, not by distance
    assert ball_query(x, x[:, 3:4], 1.0, 3).tolist() == [[[3, 3, 3]]]  # filled with the first
    assert ball_query(x, x[:, 4:], 0.5, 4).tolist() == [[[1, 2, 4, 1]]]
    far = torch.full((1, 1, 3), 9.0)
    assert ball_query(x, far, 1.0, 2).tolist() == [[[3, 3]]]  # nothing inside: the nearest


@pytest.mark.parametrize("on_device", [False, True])
@settings(max_examples=40, deadline=None)
@given(
    b=st.integers(1, 3),
    n=st.integers(1, 30),
    m=st.integers(1, 6),
    radius=st.floats(0.05, 4.0),
    count=st.integers(1, 12),
    grid=st.booleans(),
    seed=st.integers(0, 99),
)
def test_equals_brute_force(
    on_device: bool, b: int, n: int, m: int, radius: float, count: int, grid: bool, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    c = torch.randn(b, m, 3, generator=generator, dtype=torch.float64)
    if grid:  # many points exactly on the rim, and copies
        x, c, radius = x.round(), c.round(), max(1.0, round(radius))
    if on_device:
        squares = module._squared_distances(x, c)
        found = module._first(squares < radius * radius, squares, count)
    else:
        found = ball_query(x, c, radius, count)
    assert found.tolist() == brute(x, c, radius, count)
