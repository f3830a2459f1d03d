"""CPCM: its matching beside the exact one, the mixing point by point, the angle by arc cosine."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.cpcm import Cpcm, angle, exchanged, tree_order
from tests.methods.shapes import tiny_net


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 3), st.integers(1, 48), st.integers(0, 10_000))
def test_tree_order_by_recursion(b: int, n: int, seed: int) -> None:
    points = torch.rand(b, n, 3, generator=torch.Generator().manual_seed(seed))

    def ordered(cloud: list[list[float]], axis: int) -> list[list[float]]:
        cloud = sorted(cloud, key=lambda point: point[axis])
        if len(cloud) % 2:
            return cloud
        half = len(cloud) // 2
        return [p for part in (cloud[:half], cloud[half:]) for p in ordered(part, (axis + 1) % 3)]

    expected = [ordered(cloud, 0) for cloud in points.tolist()]
    assert torch.equal(tree_order(points), torch.tensor(expected))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 3), st.integers(1, 40), st.floats(0, 1), st.integers(0, 10_000))
def test_the_rest_of_one_cloud_is_exchanged_for_its_matches(b, n, lam, seed) -> None:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(b, n, 3, generator=generator)
    second = 2 + torch.rand(b, n, 3, generator=generator)
    mixed = exchanged(first, second, torch.tensor(lam), generator)
    ordered = tree_order(first), tree_order(second)
    of_second = mixed[:, :, 0] >= 2
    for i in range(b):
        assert (~of_second[i]).sum() == round(float(torch.tensor(lam).double() * n))
        places = [
            [(cloud[i] == point).all(1).nonzero()[0, 0].item() for point in mixed[i][mask]]
            for cloud, mask in zip(ordered, (~of_second[i], of_second[i]), strict=True)
        ]
        assert sorted(places[0] + places[1]) == list(range(n))  # each place once


def test_angle_known_answers() -> None:
    u = torch.tensor([[1.0, 0], [1, 0], [1, 0], [1, 1], [3, 4]], requires_grad=True)
    v = torch.tensor([[2.0, 0], [0, 5], [-3, 0], [1, 0], [3, 4]])
    found = angle(u, v)
    expected = torch.tensor([0, math.pi / 2, math.pi, math.pi / 4, 0])
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    assert torch.isfinite(u.grad).all()  # of an arc cosine it is infinite
    x, y = torch.randn(50, 7).double(), torch.randn(50, 7).double()
    torch.testing.assert_close(angle(x, y), torch.cosine_similarity(x, y).arccos())


def test_terms_by_hand() -> None:
    net, generator = tiny_net(norm=False), torch.Generator().manual_seed(0)
    clouds = torch.rand(2, 4, 32, 3, generator=generator) * 2 - 1
    source = {"points": clouds[0], "y_source": torch.arange(4)}
    batch = {"source": source, "target": {"points": clouds[1]}}
    terms = Cpcm(mix_weight=0.5).loss(net, batch, torch.Generator().manual_seed(3))
    again = torch.Generator().manual_seed(3)
    lam = torch.rand((), generator=again)
    mixed = exchanged(clouds[0], clouds[1], lam, again)
    total = 0.0
    for i in range(4):
        of = [net(x[i : i + 1])[0].detach().double() for x in (clouds[0], clouds[1], mixed)]
        mean = lam * of[0] + (1 - lam) * of[1]
        total += math.acos(float(of[2] @ mean / of[2].norm() / mean.norm())) / math.pi / 4
    assert terms["mixed"].item() == pytest.approx(0.5 * total, rel=1e-4)
    expected = torch.nn.functional.cross_entropy(net(clouds[0]), torch.arange(4))
    torch.testing.assert_close(terms["ce"], expected)
