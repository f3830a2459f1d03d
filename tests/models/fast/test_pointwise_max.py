"""The maximum over points of a layer and its norm, against the layers as they are."""

import copy

import pytest
import torch
from torch import nn

from qs3.models.fast import pointwise_max as largest
from qs3.models.norms import active, use_domain
from qs3.models.pointnet import PointMLP


def _mlp(norm: str, *, bias: bool = True, last_relu: bool = False) -> PointMLP:
    torch.manual_seed(0)
    mlp = PointMLP(3, 8, 20, norm=norm, bias=bias, last_relu=last_relu).double()
    for parameter in mlp.parameters():
        if parameter.ndim == 1:
            nn.init.normal_(parameter, 0.0, 1.0)  # negative weights of norms too
    return mlp


def _clouds() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(5, 40, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("norm", ["batch", "instance", "domain"])
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("bias", "last_relu"), [(True, True), (True, False), (False, False)])
def test_equals_the_layers(
    norm: str, training: bool, bias: bool, last_relu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(largest, "_AT_ONCE", 1 << 10)  # several parts
    mlp = _mlp(norm, bias=bias, last_relu=last_relu)
    other = copy.deepcopy(mlp)
    for _ in range(2):  # the second time with statistics of the first
        found, grads = [], []
        for net in (mlp, other):
            net.train(training).zero_grad()
            x = _clouds().requires_grad_()
            with use_domain(net, "target"):
                out = net.maximum(x) if net is mlp else net(x).amax(1)
            (out * torch.linspace(-1, 1, 20, dtype=torch.float64)).square().sum().backward()
            found.append(out)
            grads.append([x.grad, *(p.grad for p in net.parameters() if p.grad is not None)])
        torch.testing.assert_close(*found, rtol=1e-10, atol=1e-10)
        for mine, theirs in zip(*grads, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-10)
        for mine, theirs in zip(mlp.buffers(), other.buffers(), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)


def test_float32_error_is_that_of_the_layers() -> None:
    exact = _mlp("batch")
    points = _clouds().float() + 30  # a mean far larger than the spread
    single = copy.deepcopy(exact).float()
    truth = exact(points.double()).amax(1)
    straight = (copy.deepcopy(single)(points).amax(1) - truth).norm()
    assert (single.maximum(points) - truth).norm() <= 2 * straight


def test_gradient_of_equal_points_goes_to_one() -> None:
    mlp = _mlp("batch").eval()
    x = _clouds()[:1, :1].expand(1, 4, 3).clone().requires_grad_()
    mlp.maximum(x).sum().backward()
    assert (x.grad[0].abs().sum(1) > 0).sum() == 1


def test_autocast_takes_the_layers() -> None:
    mlp, points = _mlp("batch").float(), _clouds().float()
    with torch.autocast("cpu", torch.bfloat16):
        mlp.maximum(points)
    mean = active(mlp.layers[-1]).running_mean.clone()
    twin = _mlp("batch").float()
    with torch.autocast("cpu", torch.bfloat16):
        twin(points)
    assert torch.equal(mean, active(twin.layers[-1]).running_mean)
