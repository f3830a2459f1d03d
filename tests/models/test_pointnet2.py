import copy

import pytest
import torch
from torch import nn

from qs3.models import pointnet2 as pointnet2_module
from qs3.models.pointnet2 import pointnet2
from tests.models.by_formula import clouds, figures, fill
from tests.models.reference_pointnet2 import StraightPointNet2

TIGHT = {"rtol": 1e-10, "atol": 1e-10}


def _scramble(net: nn.Module) -> None:
    """Norms as after training: scales of both signs, own statistics."""
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d | nn.InstanceNorm1d):
            nn.init.normal_(module.weight, 0.3)
            nn.init.normal_(module.bias)
            if module.running_mean is not None:
                module.running_mean.normal_()
                module.running_var.uniform_(0.5, 2)


def _clouds(
    b: int = 2, n: int = 300, dtype: torch.dtype = torch.float64, seed: int = 1
) -> torch.Tensor:
    """On a sphere and a plane, in the unit ball."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    x = x / x.norm(dim=2, keepdim=True)
    x[:, ::3, 2] = -0.5
    return x.to(dtype)


def _step(net: nn.Module, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    points = points.clone().requires_grad_()
    torch.manual_seed(3)  # dropout
    logits = net(points)
    nn.functional.cross_entropy(logits, torch.arange(len(points)) % 10).backward()
    assert points.grad is not None
    return logits.detach(), points.grad


@pytest.fixture
def few_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same layers about an eighth of the centres: written straight they are slow."""
    for name in ("SSG", "MSG"):
        levels = tuple((m // 8, scales) for m, scales in getattr(pointnet2_module, name))
        monkeypatch.setattr(pointnet2_module, name, levels)


@pytest.mark.usefixtures("few_centres")
@pytest.mark.parametrize(("training", "variant"), [(True, "msg"), (True, "ssg"), (False, "ssg")])
def test_whole_net_equals_the_straight_one(variant: str, training: bool) -> None:
    torch.manual_seed(0)
    ours = pointnet2(10, variant).double().train(training)
    _scramble(ours)
    straight = StraightPointNet2(copy.deepcopy(ours)).train(training)
    points = _clouds(6, 200)
    (a, da), (b, db) = _step(ours, points), _step(straight, points)
    torch.testing.assert_close(a, b, **TIGHT)
    torch.testing.assert_close(da, db, rtol=0.0, atol=1e-10 * max(1.0, float(db.abs().max())))


@pytest.mark.usefixtures("few_centres")
def test_float32_errs_no_more_than_twice_the_straight_one() -> None:
    """As a sum over clouds: of a few, one maximum that goes elsewhere can outweigh all rounding."""
    torch.manual_seed(0)
    exact = pointnet2(10, "ssg", dropout=0.0).double()
    straight = StraightPointNet2(copy.deepcopy(exact).float())
    ours = copy.deepcopy(exact).float()
    errors = torch.zeros(2)
    for seed in range(4):
        points = _clouds(6, 200, torch.float32, seed)
        truth = exact(points.double())
        errors += torch.tensor([_error(ours(points), truth), _error(straight(points), truth)])
    assert errors[0] <= 2 * errors[1], errors


def _error(value: torch.Tensor, truth: torch.Tensor) -> float:
    return float(((value - truth).norm() / truth.norm()).detach())


ORIGINAL = {  # logits of the first cloud, norm of the gradient in the points
    ("ssg", True): (
        *(0.0298412, 0.151493, -0.135183, -0.117643, 0.20685),
        *(0.00776706, -0.162699, 0.0530215, 0.0558266, 0.00299757, 17401.6),
    ),
    ("ssg", False): (
        *(-0.0294398, 0.0591844, -0.0735068, -0.0269349, 0.142819),
        *(-0.0812794, -0.0963575, 0.140346, -0.0127811, -0.0825467, 0.00162204),
    ),
    ("msg", True): (
        *(0.157728, -0.380308, -0.120848, 0.283043, 0.19502),
        *(-0.275816, -0.282661, 0.373335, 0.27029, -0.467633, 204814),
    ),
    ("msg", False): (
        *(-0.0667892, 0.0209309, 0.0932563, -0.123753, -0.00852767),
        *(0.136262, -0.0898078, -0.043748, 0.0882605, -0.0458262, 0.000371285),
    ),
}


@pytest.mark.parametrize(("variant", "training"), ORIGINAL)
def test_numbers_of_an_original(variant: str, training: bool) -> None:
    """yanx27/Pointnet_Pointnet2_pytorch in float64; see docs/reference/backbones.md."""
    net = pointnet2(10, variant, dropout=0.0).double()
    fill([net])
    if variant == "msg":  # there the features come first
        for mlp in net.backbone.levels[1].mlps:
            weight = mlp.linears[0].weight.data
            weight.copy_(torch.cat([weight[:, -3:], weight[:, :-3]], dim=1))
    points = clouds(4, 700)
    points = (points / points.norm(dim=2).amax(1)[:, None, None]).requires_grad_()
    *expected, gradient = ORIGINAL[variant, training]
    *found, found_gradient = figures(net.train(training)(points), points)
    assert found == pytest.approx(expected, abs=1e-5)
    assert found_gradient == pytest.approx(gradient, rel=1e-5)


def test_autocast_keeps_neighbours_and_groups_in_float32() -> None:
    torch.manual_seed(0)
    net = pointnet2(10, "ssg").eval()
    points = _clouds(2, 256, torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        half = net.features(points).global_
    torch.testing.assert_close(half.float(), net.features(points).global_)
