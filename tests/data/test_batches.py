from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qs3.data.batches import Batches, Table


def table(n: int) -> Table:
    return Table(torch.arange(n).float().reshape(n, 1, 1).expand(n, 2, 3), {"y": torch.arange(n)})


def seen(batches: Batches, name: str = "a") -> list[int]:
    return [int(y) for batch in batches for y in batch[name]["y"]]


def batches(n: int, size: int = 4, **kw) -> Batches:
    return Batches({"a": table(n)}, size, **{"seed": 0, "epoch": 0, **kw})


@given(st.integers(2, 50), st.integers(2, 9))
def test_each_cloud_once_and_no_batch_of_one(n, size):
    epoch = batches(n, size)
    assert sorted(seen(epoch)) == list(range(n))
    sizes = [len(batch["a"]["points"]) for batch in epoch]
    assert len(sizes) == len(epoch)
    assert min(sizes) >= 2
    assert max(sizes) <= size + 1


def test_order_is_a_function_of_seed_and_epoch():
    assert seen(batches(20)) == seen(batches(20))
    assert seen(batches(20)) != seen(batches(20, epoch=1))
    assert seen(batches(20)) != seen(batches(20, seed=1))
    assert seen(batches(20, shuffle=False)) == list(range(20))


@pytest.mark.parametrize("n", [8, 9])
def test_processes_share_the_clouds_equally(n):
    one, two = (seen(batches(n, rank=r, world=2)) for r in (0, 1))
    assert len(one) == len(two)
    assert set(one) | set(two) == set(range(n))


def test_the_first_table_decides_the_length():
    both = Batches({"a": table(10), "b": table(3)}, 4, seed=0, epoch=0)
    assert [len(batch["b"]["y"]) for batch in both] == [4, 4, 2]
    assert sorted(seen(both, "b")[:3]) == [0, 1, 2]
