"""Every net of conf/model with every norm: passes, one cloud, domains, AdaBN."""

from typing import Any

import pytest
import torch
from torch import nn

from qs3.kernels import plain
from qs3.kernels.norms import adapt_batchnorm, use_domain
from qs3.models import pointnet2, rscnn
from qs3.models.base import PointClassifier
from tests.models.test_all_nets import NETS, UNDROPPED, build, clouds, each_net

SMALL = {
    "dgcnn": {"k": 8},
    "pointdan": {"nodes": 8, "neighbours": 8},
    "simpleview": {"image_size": 32, "channels": 4},
}
TIGHT = {"rtol": 1e-9, "atol": 1e-9}


@pytest.fixture(autouse=True)
def _few_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nets with groups have as many of them whatever the cloud; here few, and of few channels."""
    for name in ("SSG", "MSG"):
        levels = []
        for centres, scales in getattr(pointnet2, name):
            few = [(s.radius, min(s.members, 12), tuple(w // 8 for w in s.widths)) for s in scales]
            levels.append((centres // 32, tuple(pointnet2.Scale(*one) for one in few)))
        monkeypatch.setattr(pointnet2, name, tuple(levels))
    monkeypatch.setattr(rscnn, "LEVELS", ((16, 0.5, 8), (6, 0.8, 12)))


def _small(name: str, norm: str, **settings: Any) -> PointClassifier:
    net = build(name, norm=norm, **SMALL.get(name, {}), **settings)
    for key, parameter in net.named_parameters():  # as after some training
        if parameter.ndim == 1 and "norm" in key:
            nn.init.normal_(parameter, 1.0 if key.endswith("weight") else 0.0, 0.3)
    return net


def _statistics(net: nn.Module) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in net.named_buffers() if "running" in key}


@each_net
def test_domains(name: str) -> None:
    """On the source it is batch norm; a pass on the target changes and uses the target's alone."""
    small: dict[str, Any] = SMALL.get(name, {}) | ({} if name in UNDROPPED else {"dropout": 0.0})
    batch, net = (build(name, norm=norm, **small) for norm in ("batch", "domain"))
    points = clouds(3, 50)
    for training in (True, False):
        outs = []
        for some in (batch, net):
            torch.manual_seed(0)  # where nodes start in training
            outs.append(some.train(training)(points))
        torch.testing.assert_close(*outs, rtol=1e-10, atol=1e-10)
    net = _small(name, "domain").train()
    before = _statistics(net)
    with use_domain(net, "target"):
        net(points).square().sum().backward()
    after = _statistics(net)
    for key, value in after.items():
        assert torch.equal(value, before[key]) == (".source." in key), key
    for key, parameter in net.named_parameters():
        assert (parameter.grad is None) == (".source." in key), key


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "batch") for name in NETS), ("dgcnn", "domain")]
)
def test_adabn_against_brute_force(name: str, kind: str) -> None:
    """Each norm holds mean and variance of all rows that the plain form hands it in the same pass.

    In three batches of unequal size, after statistics of something else.
    """
    net = _small(name, kind)
    net.train()(2 * clouds(4, 30))
    net.eval()
    points = clouds(9, 60)
    batches = [points[:4], points[4:6], points[6:]]
    weights = [p.clone() for p in net.parameters()]
    before = _statistics(net)
    with use_domain(net, "target"):
        adapted = adapt_batchnorm(net, batches)
        norms = [m for m in net.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
        assert len(adapted) == (len(norms) if kind == "batch" else len(norms) // 2)
        assert all(torch.equal(a, b) for a, b in zip(weights, net.parameters(), strict=True))
        for key, value in _statistics(net).items():
            assert torch.equal(value, before[key]) == (".source." in key), key
        held = {norm: (norm.running_mean.clone(), norm.running_var.clone()) for norm in adapted}
        given: dict[nn.Module, list[torch.Tensor]] = {norm: [] for norm in adapted}
        for norm in adapted:
            norm.training = True
            norm.register_forward_pre_hook(
                lambda norm, inputs: given[norm].append(inputs[0].transpose(0, 1).flatten(1))
            )
        with torch.no_grad(), plain():
            for batch in batches:
                net(batch)
        for norm, (mean, variance) in held.items():
            rows = torch.cat(given[norm], dim=1)  # [C, rows]
            torch.testing.assert_close(rows.mean(1), mean, **TIGHT)
            torch.testing.assert_close(rows.var(1), variance, **TIGHT)
