"""Every net of conf/model with every norm: passes, one cloud, domains, AdaBN."""

import copy
from typing import Any

import pytest
import torch
from torch import nn

from qs3.errors import ConfigError
from qs3.models import pointnet2, rscnn
from qs3.models.base import PointClassifier
from qs3.models.norms import KINDS, DomainNorm, active, adapt_batchnorm, norms_for, use_domain
from qs3.models.pointnet import PointMLP
from tests.models import reference_rscnn
from tests.models.reference import NaiveDGCNN
from tests.models.reference_pointnet2 import StraightPointNet2
from tests.models.reference_rscnn import NaiveRSCNN
from tests.models.reference_simpleview import NaiveSimpleView
from tests.models.test_all_nets import NETS, build, clouds

SMALL = {
    "dgcnn": {"k": 8},
    "pointdan": {"nodes": 8, "neighbours": 8},
    "simpleview": {"image_size": 32, "channels": 4},
}
STRAIGHT: dict[str, type[nn.Module]] = {  # where the net's own layers never call their norms
    "dgcnn": NaiveDGCNN,
    "pointnet2": StraightPointNet2,
    "pointnet2_ssg": StraightPointNet2,
    "rscnn": NaiveRSCNN,
    "simpleview": NaiveSimpleView,
}
TIGHT = {"rtol": 1e-9, "atol": 1e-9}


@pytest.fixture(autouse=True)
def _few_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nets with groups have as many of them whatever the cloud; here few, and of few channels."""
    for name in ("SSG", "MSG"):
        levels = tuple(
            (
                centres // 32,
                tuple(
                    pointnet2.Scale(s.radius, min(s.members, 12), tuple(w // 8 for w in s.widths))
                    for s in scales
                ),
            )
            for centres, scales in getattr(pointnet2, name)
        )
        monkeypatch.setattr(pointnet2, name, levels)
    for module in (rscnn, reference_rscnn):
        monkeypatch.setattr(module, "LEVELS", ((16, 0.5, 8), (6, 0.8, 12)))


def _small(name: str, norm: str, **settings: Any) -> PointClassifier:
    net = build(name, norm=norm, **SMALL.get(name, {}), **settings)
    for key, parameter in net.named_parameters():  # as after some training
        if parameter.ndim == 1 and "norm" in key:
            nn.init.normal_(parameter, 1.0 if key.endswith("weight") else 0.0, 0.3)
    return net


def _statistics(net: nn.Module) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in net.named_buffers() if "running" in key}


@pytest.mark.parametrize("norm", KINDS)
@pytest.mark.parametrize("name", NETS)
def test_forward_backward_and_one_cloud(name: str, norm: str) -> None:
    net, points = _small(name, norm).train(), clouds(3, 50)
    net(points).square().sum().backward()
    for key, parameter in net.named_parameters():
        if ".target." in key and norm == "domain":
            assert parameter.grad is None, key
        else:
            assert parameter.grad is not None, key
            assert parameter.grad.isfinite().all(), key
    alone = torch.cat([net.eval()(cloud[None]) for cloud in points])
    torch.testing.assert_close(net(points), alone, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", NETS)
def test_parameters_and_keys(name: str) -> None:
    """Only a domain's own scale and shift are more; they are named after the domain."""

    def count(net: nn.Module) -> int:
        return sum(p.numel() for p in net.parameters())

    batch, domain = build(name, norm="batch"), build(name, norm="domain")
    norms = [m for m in batch.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
    assert count(domain) == count(batch) + 2 * sum(norm.num_features for norm in norms)
    assert count(build(name, norm="instance")) == count(batch)
    assert count(build(name, norm="domain_statistics")) == count(batch)
    keys = {key.replace(".source.", ".").replace(".target.", ".") for key in domain.state_dict()}
    assert keys == set(batch.state_dict())


@pytest.mark.parametrize("kind", ["domain", "domain_statistics"])
@pytest.mark.parametrize("name", NETS)
def test_a_pass_on_one_domain_leaves_the_other_alone(name: str, kind: str) -> None:
    net = _small(name, kind).train()
    before, points = _statistics(net), clouds(3, 50)
    with use_domain(net, "target"):
        net(points).square().sum().backward()
    after = _statistics(net)
    assert before
    for key, value in after.items():
        assert torch.equal(value, before[key]) == (".source." in key), key
    source = [p.grad for k, p in net.named_parameters() if k.endswith(".source.weight")]
    assert source
    assert all((grad is None) == (kind == "domain") for grad in source)
    assert norms_for(net, "target") == "target"
    net.eval()
    with use_domain(net, "target"):
        as_target = net(points)
    assert (as_target - net(points)).abs().max() > 1e-3


@pytest.mark.parametrize("name", NETS)
def test_on_source_it_is_batch_norm(name: str) -> None:
    settings = {} if name == "pointdan" else {"dropout": 0.0}
    plain = build(name, norm="batch", **SMALL.get(name, {}), **settings)
    several = build(name, norm="domain", **SMALL.get(name, {}), **settings)
    for training in (True, False):
        outs = []
        for net in (plain, several):
            torch.manual_seed(0)  # where nodes start in training
            outs.append(net.train(training)(clouds(3, 50)))
        torch.testing.assert_close(*outs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["batch", "domain"])
@pytest.mark.parametrize("name", NETS)
def test_exact_adabn_against_brute_force(
    name: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each norm holds what the straight net finds in one pass over all clouds, others in eval.

    In three batches of unequal size, after statistics of something else.
    """
    net = _small(name, kind)
    net.train()(2 * clouds(4, 30))
    net.eval()
    points = clouds(9, 60)
    weights = [p.clone() for p in net.parameters()]
    before = _statistics(net)
    with use_domain(net, "target"):
        adapted = adapt_batchnorm(net, [points[:4], points[4:6], points[6:]], exact=True)
        norms = [m for m in net.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
        assert len(adapted) == (len(norms) if kind == "batch" else len(norms) // 2)
        assert all(torch.equal(a, b) for a, b in zip(weights, net.parameters(), strict=True))
        if kind == "domain":
            for key, value in _statistics(net).items():
                assert torch.equal(value, before[key]) == (".source." in key), key
        if kind == "domain" and name in STRAIGHT:
            straight: nn.Module = net  # the straight nets have one domain
        else:
            straight = STRAIGHT.get(name, copy.deepcopy)(net)  # type: ignore[arg-type]
        monkeypatch.setattr(PointMLP, "maximum", lambda mlp, x: mlp(x).amax(1))
        straight.eval()
        asked = [
            active(m)
            for m in straight.modules()
            if isinstance(m, DomainNorm | nn.modules.batchnorm._BatchNorm)
        ]
        asked = [n for i, n in enumerate(asked) if all(n is not other for other in asked[:i])]
        if kind == "domain":
            asked = [n for n in asked if all(n is not m.source for m in _domains(straight))]
        assert len(asked) == len(adapted)
        for norm in asked:
            held = norm.running_mean.clone(), norm.running_var.clone()
            norm.training, norm.momentum = True, 1.0
            with torch.no_grad():
                straight(points)
            torch.testing.assert_close(norm.running_mean, held[0], **TIGHT)
            torch.testing.assert_close(norm.running_var, held[1], **TIGHT)
            norm.training = False
            norm.running_mean.copy_(held[0])
            norm.running_var.copy_(held[1])


def _domains(net: nn.Module) -> list[DomainNorm]:
    return [m for m in net.modules() if isinstance(m, DomainNorm)]


@pytest.mark.parametrize("name", NETS)
def test_adabn_leaves_nothing_to_chance(name: str) -> None:
    """One pass, twice, with torch's generator elsewhere: the same statistics to the bit."""
    net, points = _small(name, "batch"), clouds(6, 40)
    found = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        twin = copy.deepcopy(net).train()
        adapt_batchnorm(twin, [points[:3], points[3:]])
        assert all(module.training for module in twin.modules())
        found.append(_statistics(twin))
    for key, value in found[0].items():
        assert torch.equal(value, found[1][key]), key


def test_a_norm_that_takes_no_statistics_is_named() -> None:
    class Dead(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.used, self.unused = nn.BatchNorm1d(3), nn.BatchNorm1d(3)

        def forward(self, points: torch.Tensor) -> torch.Tensor:
            return self.used(points.mean(1))

    with pytest.raises(ConfigError, match="unused takes no statistics"):
        adapt_batchnorm(Dead(), [torch.randn(4, 5, 3)])
