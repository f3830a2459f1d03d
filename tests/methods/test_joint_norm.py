"""Joint norms against a norm worked out by hand, and what they leave alone."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.methods.joint_norm import JointNorm
from qs3.methods.source_only import SourceOnly
from qs3.models.dgcnn import dgcnn
from tests.methods.shapes import CLASSES, tiny_net


class OneNorm(nn.Module):
    """A cloud's mean, its batch norm, and logits."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.last = nn.BatchNorm1d(3), nn.Linear(3, CLASSES)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.last(self.norm(points.mean(1)))


def _batch(b: int = 6) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    clouds = torch.randn(2, b, 32, 3, generator=generator)
    source = {"points": clouds[0], "y_source": torch.arange(b) % CLASSES}
    return {"source": source, "target": {"points": 3 * clouds[1] + 2}, "progress": 0.5}


def test_the_norm_s_mean_and_variance_are_of_both_domains() -> None:
    torch.manual_seed(0)
    net, batch = OneNorm(), _batch()
    loss = JointNorm().loss(net, batch, torch.Generator())["ce"]
    both = torch.cat([batch["source"]["points"], batch["target"]["points"]]).mean(1)  # [12, 3]
    mean, var = both.mean(0), both.var(0, unbiased=False)
    normed = (both[:6] - mean) / (var + 1e-5).sqrt()
    torch.testing.assert_close(loss, F.cross_entropy(net.last(normed), batch["source"]["y_source"]))
    torch.testing.assert_close(net.norm.running_mean, 0.1 * mean)


def test_the_target_teaches_by_the_norms_alone() -> None:
    """Without a norm its clouds change nothing; with one the loss and its gradients."""
    for norm in (False, True):
        net, batch = tiny_net(norm=norm), _batch()
        found = []
        for method in (JointNorm(), SourceOnly()):
            one = copy.deepcopy(net)
            loss = method.loss(one, batch, torch.Generator())["ce"]
            loss.backward()
            found.append([loss.detach(), *(p.grad for p in one.parameters())])
        alike = [torch.allclose(a, b, rtol=1e-4, atol=1e-6) for a, b in zip(*found, strict=True)]
        assert all(alike) if not norm else not any(alike[:2])


def test_a_norm_of_each_domain_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"model\.norm=domain keeps them apart"):
        JointNorm().prepare(dgcnn(CLASSES, k=4, norm="domain"))
