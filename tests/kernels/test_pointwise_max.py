"""The maximum over points of a layer and its norm, against the layers as they are."""

import copy

import torch
from torch import nn

from qs3.models.pointnet import PointMLP


def _mlp() -> PointMLP:
    torch.manual_seed(0)
    mlp = PointMLP(3, 8, 20, last_relu=False).double()
    for parameter in mlp.parameters():
        if parameter.ndim == 1:
            nn.init.normal_(parameter, 0.0, 1.0)  # negative weights of norms too
    return mlp


def _clouds() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(5, 40, 3, generator=generator, dtype=torch.float64)


def test_float32_error_is_that_of_the_layers() -> None:
    exact = _mlp()
    points = _clouds().float() + 30  # a mean far larger than the spread
    single = copy.deepcopy(exact).float()
    truth = exact(points.double()).amax(1)
    straight = (copy.deepcopy(single)(points).amax(1) - truth).norm()
    assert (single.maximum(points) - truth).norm() <= 2 * straight


def test_gradient_of_equal_points_goes_to_one() -> None:
    mlp = _mlp().eval()
    x = _clouds()[:1, :1].expand(1, 4, 3).clone().requires_grad_()
    mlp.maximum(x).sum().backward()
    assert (x.grad[0].abs().sum(1) > 0).sum() == 1
