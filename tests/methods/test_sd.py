"""SD: running means by hand, the loss by loops, and a part of the target that only it teaches."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.sd import Sd, spoilt
from tests.methods.shapes import tiny_net


def _batch(progress: float = 1.0) -> dict:
    points = torch.rand(2, 4, 24, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return {
        "source": {"points": points[0], "y_source": torch.arange(4)},
        "target": {"points": points[1]},
        "progress": progress,
    }


def test_the_teacher_is_a_running_mean() -> None:
    """A plain one at first, of what the student was at the beginning and after each step."""
    momentum = 0.6
    net, method = tiny_net(), Sd(momentum=momentum)
    method.prepare(net)
    mean = {}
    for t in range(6):
        with torch.no_grad():
            for p in net.parameters():
                p += torch.randn_like(p)
        net.features(torch.randn(4, 10, 3))  # moves batch norm's statistics
        method.follow(net)
        part = max(1 / (t + 1), 1 - momentum)
        for name, value in net.state_dict().items():
            mean[name] = value.double() * part + mean.get(name, 0.0) * (1 - part)
    for name, value in method.teacher.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value.double(), mean[name], rtol=1e-4, atol=1e-5)
        else:
            assert value == net.state_dict()[name]


def test_the_loss_by_loops() -> None:
    net, batch = tiny_net(norm=False), _batch(progress=0.5)
    method = Sd(consistency_weight=2.0)
    method.prepare(net)
    method.follow(net)
    with torch.no_grad():
        for p in net.parameters():
            p += 0.1 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1))
    terms = method.loss(net, batch, torch.Generator().manual_seed(3))
    generator, each = torch.Generator().manual_seed(3), []
    for domain, kept in (("source", 0.7), ("target", 1.0)):
        clouds = batch[domain]["points"]
        for seen, whole in zip(spoilt(clouds, kept, generator), clouds, strict=True):
            f = net.features(seen[None]).global_[0].detach().double() / 0.5
            g = method.teacher.features(whole[None]).global_[0].double() / 0.1
            q = [math.exp(x - g.max()) for x in g]
            each.append(-sum(a / sum(q) * b for a, b in zip(q, f.log_softmax(0), strict=True)))
    expected = 2.0 * math.exp(-5 * 0.25) * sum(each) / 8
    assert terms["consistency"].item() == pytest.approx(float(expected), rel=1e-4)
    assert set(terms) == {"ce", "consistency"}


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 4), st.integers(1, 40), st.floats(0.05, 1.0), st.integers(0, 10_000))
def test_what_stays_lies_before_a_plane(b: int, n: int, kept: float, seed: int) -> None:
    points = torch.rand(b, n, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    found = spoilt(points, kept, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed)
    size = 0.7 + 0.8 * torch.rand(b, 1, 1, generator=generator)
    whole, left = points * size, max(1, round(kept * n))
    assert ((size >= 0.7) & (size <= 1.5)).all()
    normal = torch.randn(b, 3, 1, generator=generator) if left < n else torch.ones(b, 3, 1)
    for i in range(b):
        stays = (whole[i][:, None] == found[i][None]).all(2).any(1)
        assert stays.sum() == left
        assert (found[i][:, None] == whole[i][None]).all(2).any(1).all()
        height = (whole[i] @ normal[i])[:, 0]
        if left < n:
            assert height[stays].min() >= height[~stays].max() - 1e-6
