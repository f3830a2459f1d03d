from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qs3.datamodules.batches import Batches, Piece
from qs3.datamodules.clouds import Clouds, Labelled
from qs3.utils.seeding import derive

SAMPLES = 3


def part(n: int, balanced: bool = False, starts: int = 1) -> Labelled:
    """n clouds of the points 0 and i + 1, whose label is i; or 0 of the first alone, if balanced.

    With several samples, sample s is the point s alone.
    """
    stored = np.zeros((n, SAMPLES, 3), dtype=np.float32)
    stored[:, :, 0] = np.arange(SAMPLES)
    order = None if starts == 1 else np.tile(np.arange(starts)[:, None], (n, 1, 1))
    labels = torch.arange(n).clamp(max=1) if balanced else torch.arange(n)
    return Labelled(Clouds.of(stored, order), labels, "y", balanced)


def seen(batches: Batches, name: str = "a") -> list[int]:
    return [int(y) for batch in batches for y in batch[name]["y"]]


def batches(n: int, size: int = 4, balanced: bool = False, **kw) -> Batches:
    return Batches({"a": part(n, balanced)}, size, **{"seed": 0, "epoch": 0, **kw})


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


def one_by_one(name: str, n: int, rank: int, world: int):
    """The order, written straight: this process's share of one permutation after another."""
    for passed in itertools.count():
        generator = torch.Generator().manual_seed(derive(0, "shuffle", name, 5, passed))
        order = torch.randperm(n, generator=generator).tolist()
        padded = order + order[: -n % world]
        yield from padded[rank::world]


@given(st.integers(2, 40), st.integers(2, 40), st.integers(1, 3), st.integers(2, 9))
def test_order_against_one_drawn_cloud_by_cloud(n, other, world, size):
    for rank in range(world):
        both = Batches(
            {"a": part(n), "b": part(other)}, size, seed=0, epoch=5, rank=rank, world=world
        )
        for name, count in (("a", n), ("b", other)):
            expected = one_by_one(name, count, rank, world)
            assert seen(both, name) == list(itertools.islice(expected, sum(both.sizes)))


@pytest.mark.parametrize("n", [1, 2, 8, 9])
def test_processes_share_the_clouds_equally(n):
    parts = [seen(batches(n, rank=r, world=4)) for r in range(4)]
    assert len({len(part) for part in parts}) == 1
    assert set().union(*parts) == set(range(n))


# --- one of several samples -------------------------------------------------------------------


def samples(seed: int = 0, epoch: int = 0, **kw) -> dict[int, int]:
    """Which sample of each cloud an epoch takes, by the point that the sample consists of."""
    drawn = Batches({"a": part(60, starts=3)}, 8, seed=seed, epoch=epoch, **kw)
    radius = 1.0  # of the points 0, 1, 2 about 1
    return {
        int(y): round(float(point[0, 0]) * radius + 1)
        for batch in drawn
        for y, point in zip(batch["a"]["y"], batch["a"]["points"], strict=True)
    }


def test_an_epoch_draws_a_sample_for_each_cloud():
    first = samples()
    assert set(first.values()) == {0, 1, 2}
    counts = np.bincount(list(first.values()))
    assert counts.min() > 10  # of 60; a third each
    assert samples() == first
    assert samples(epoch=1) != first
    assert samples(seed=1) != first
    assert set(samples(shuffle=False).values()) == {0}  # evaluation


def test_the_sample_does_not_depend_on_the_number_of_processes():
    whole = samples()
    for rank in range(3):
        part = samples(rank=rank, world=3)
        assert len(part) == 20
        assert part.items() <= whole.items()


# --- balanced classes -------------------------------------------------------------------------


def test_all_classes_are_equally_likely_and_the_epoch_stays_as_long():
    drawn = seen(batches(1000, balanced=True))
    assert len(drawn) == 1000
    first_class = drawn.count(0)  # one cloud of 1,000
    assert first_class == pytest.approx(500, abs=79)  # 5 sigma
    assert seen(batches(1000, balanced=True)) == drawn
    assert seen(batches(1000, balanced=True, epoch=1)) != drawn


@pytest.mark.slow
@given(
    n=st.integers(2, 30),
    other=st.integers(2, 30),
    size=st.integers(2, 8),
    cuts=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    world=st.integers(1, 3),
)
def test_pieces_of_a_way_put_together_are_the_way(n, other, size, cuts, world):
    """However it is cut into epochs: the same batches of each process, and none is short."""

    def epoch(piece, number, rank=0):
        parts = {"a": part(n), "b": part(other)}
        more = {"rank": rank, "world": world, "piece": piece}
        return Batches(parts, size, seed=0, epoch=number, **more)

    ends = list(itertools.accumulate(cuts))
    for rank in range(world):
        whole = epoch(Piece(7, 0, ends[-1]), 0, rank)
        pieces = [
            epoch(Piece(7, end - count, end), i, rank)
            for i, (count, end) in enumerate(zip(cuts, ends, strict=True))
        ]
        for name in ("a", "b"):
            parts = [y for piece in pieces for y in seen(piece, name)]
            assert parts == seen(whole, name)
        assert [len(piece) for piece in pieces] == cuts
        assert all(len(batch["a"]["points"]) == size for piece in pieces for batch in piece)


@given(n=st.integers(2, 30), size=st.integers(2, 8))
def test_on_a_way_every_cloud_comes_before_any_comes_again(n, size):
    passes = 3
    way = seen(batches(n, size, piece=Piece(0, 0, -(-passes * n // size))))
    for i in range(passes):
        assert sorted(way[i * n : (i + 1) * n]) == list(range(n))
