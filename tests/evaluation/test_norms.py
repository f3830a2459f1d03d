"""TENT: a step by hand, and what it leaves alone."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from qs3.evaluation.norms import RATE, adapt_norms, minimise_entropy
from qs3.kernels.norms import use_domain
from qs3.models.base import ClassHead, PointClassifier
from qs3.models.dgcnn import DGCNN
from tests.methods.shapes import tiny_net


def entropy(logits: torch.Tensor) -> torch.Tensor:
    return -(logits.softmax(dim=1) * logits.log_softmax(dim=1)).sum(dim=1).mean()


def _net(kind: str) -> nn.Module:
    if kind == "tiny":
        return tiny_net()
    torch.manual_seed(0)
    backbone = DGCNN(k=4, widths=(8, 8, 8, 16), embedding=32, norm=kind)
    return PointClassifier(backbone, ClassHead(64, 4, hidden=(16,), dropout=0.5, norm=kind))


@pytest.mark.parametrize("kind", ["tiny", "domain"])
def test_only_norms_change_and_entropy_falls(kind: str) -> None:
    net, clouds = _net(kind), torch.randn(64, 24, 3, generator=torch.Generator().manual_seed(0))
    net.train()
    for domain in ("source", "target"):
        with use_domain(net, domain):
            net(clouds[:8])
    net.backbone.requires_grad_(False)  # as the user left it
    before, wanted = copy.deepcopy(net.state_dict()), [p.requires_grad for p in net.parameters()]
    plain = copy.deepcopy(net)
    state = torch.get_rng_state()
    minimise_entropy(net, clouds, 4, seed=0)
    adapt_norms(plain, clouds, 4, seed=0)
    assert torch.equal(torch.get_rng_state(), state)  # no dropout
    assert [p.requires_grad for p in net.parameters()] == wanted
    assert all(p.grad is None for p in net.parameters())
    assert all(module.training for module in net.modules())
    norms = {f"{name}." for name, m in net.named_modules() if isinstance(m, nn.BatchNorm1d)}
    changed = {k for k, value in net.state_dict().items() if not torch.equal(value, before[k])}
    assert all(any(key.startswith(norm) for norm in norms) for key in changed)
    if kind == "domain":
        assert not any("source" in key for key in changed)
    assert any(key.endswith("weight") for key in changed)
    assert any(key.endswith("bias") for key in changed)
    found = []
    for one in (net, plain):
        one.eval()
        with torch.no_grad(), use_domain(one, "target"):
            found.append(entropy(one(clouds)).item())
    assert found[0] < found[1]


def test_a_step_by_hand() -> None:
    """One batch: Adam's first step is the rate along the sign of each derivative."""
    net, clouds = tiny_net(), torch.randn(8, 24, 3)
    twin = copy.deepcopy(net)
    minimise_entropy(net, clouds, 8, seed=0)
    entropy(twin.train()(clouds)).backward()
    for (name, after), before in zip(net.named_parameters(), twin.parameters(), strict=True):
        step = torch.zeros_like(after)
        if any(name.startswith(n) and n for n, m in twin.named_modules() if _is_norm(m)):
            step = -RATE * before.grad.sign()
            sure = before.grad.abs() > 1e-5  # where rounding does not decide
            torch.testing.assert_close((after - before)[sure], step[sure], rtol=1e-2, atol=1e-6)
        else:
            assert torch.equal(after, before)


def _is_norm(module: nn.Module) -> bool:
    return isinstance(module, nn.BatchNorm1d)
