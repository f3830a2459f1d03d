"""Each layer's kernel against the formula that stands in its `forward`: the same in float64.

Outputs, gradients of inputs and parameters, running statistics; any shapes, norms, both modes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from qs3.geometry.ball_query import ball_query
from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels import grouped_mlp_max, linear_max, plain, pointwise_max, rsconv
from qs3.kernels.norms import use_domain
from qs3.models.dgcnn import DGCNN, EdgeConv
from qs3.models.pointnet import PointMLP
from qs3.models.pointnet2 import GroupedMLP
from qs3.models.rscnn import RSConv
from tests.device import as_on_device, as_on_gpu

Draw = Callable[[int, int], int]
Inputs = list[Tensor]  # what gets a gradient
Case = tuple[nn.Module, Inputs, Callable[[nn.Module, Inputs], Tensor]]


def _cloud(draw: Draw, channels: int = 3) -> Tensor:
    """Some points of a cloud are copies of others."""
    x = torch.randn(draw(1, 3), draw(3, 24), channels, dtype=torch.float64)
    x[:, 1 :: draw(2, 4)] = x[:, :1]
    return x


def edge_conv(draw: Draw, norm: str) -> Case:
    x = _cloud(draw, draw(1, 6))
    index = torch.randint(x.shape[1], (*x.shape[:2], draw(1, 6)))  # any, not only the nearest
    layer = EdgeConv(x.shape[2], draw(1, 9), norm=norm)
    return layer, [x], lambda layer, inputs: layer(inputs[0], index)


def pooled_conv5(draw: Draw, norm: str) -> Case:
    variant = ("uda", "simpleview", "defrec")[draw(0, 2)]
    net = DGCNN(k=3, variant=variant, norm=norm, widths=(4, 5), embedding=draw(1, 8))
    # Two clouds for the T-Net's norms; no copies, of which any could become a neighbour.
    points = torch.randn(draw(2, 3), draw(3, 24), 3, dtype=torch.float64)
    return net, [points], lambda net, inputs: net(inputs[0]).global_


def point_mlp(draw: Draw, norm: str) -> Case:
    widths = [draw(1, 8) for _ in range(draw(2, 4))]
    mlp = PointMLP(*widths, last_relu=draw(0, 1) > 0, bias=draw(0, 1) > 0, norm=norm)
    return mlp, [_cloud(draw, widths[0])], lambda mlp, inputs: mlp.maximum(inputs[0])


def grouped_mlp(draw: Draw, norm: str) -> Case:
    xyz, channels = _cloud(draw), draw(0, 4)
    features = [torch.randn(*xyz.shape[:2], channels, dtype=torch.float64)] if channels else []
    centres = gather(xyz, farthest_point_sampling(xyz, draw(1, 8)))
    index = torch.randint(xyz.shape[1], (*centres.shape[:2], draw(2, 7)))
    mlp = GroupedMLP(channels, [draw(1, 9) for _ in range(draw(2, 4))], norm=norm)

    def run(mlp: nn.Module, inputs: Inputs) -> Tensor:
        xyz, centres, *features = inputs
        return mlp(xyz, features[0] if features else None, centres, index)

    return mlp, [xyz, centres, *features], run


def rs_conv(draw: Draw, norm: str) -> Case:
    xyz, channels = _cloud(draw), draw(0, 4)
    if norm == "instance":  # the kernel takes one cloud
        xyz = xyz[:1]
    features = [torch.randn(*xyz.shape[:2], channels, dtype=torch.float64)] if channels else []
    centres = gather(xyz, farthest_point_sampling(xyz, draw(2, 8)))
    relation = ("released", "paper")[draw(0, 1)]
    index = ball_query(xyz, centres, 0.5 + draw(0, 4) / 2, draw(2, 6))
    layer = RSConv(channels, draw(1, 8), draw(1, 8), relation, norm=norm)

    def run(layer: nn.Module, inputs: Inputs) -> Tensor:
        return layer(xyz, inputs[0] if inputs else None, centres, index)

    return layer, features, run


LAYERS = (edge_conv, pooled_conv5, point_mlp, grouped_mlp, rs_conv)


@pytest.fixture(autouse=True, scope="module")
def _many_parts() -> Iterator[None]:
    """Kernels work on parts of what they are given; here on small ones."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (grouped_mlp_max, linear_max, pointwise_max, rsconv):
            patch.setattr(module, "_AT_ONCE", 1 << 7)
        yield


def _of_places(x: Tensor) -> Tensor | None:
    """[B, N, C] the gradient, summed over copies of a point: which one a maximum takes is open."""
    if x.grad is None:
        return None
    summed = torch.zeros_like(x)
    for cloud, grad, out in zip(x.detach(), x.grad, summed, strict=True):
        _, place = torch.unique(cloud, dim=0, return_inverse=True)
        out.index_add_(0, place, grad)
    return summed


@pytest.mark.parametrize("layer", LAYERS)
@settings(max_examples=20, deadline=None)
@given(st.data())
def test_kernel_equals_formula(layer: Callable[[Draw, str], Case], data: st.DataObject) -> None:
    def draw(low: int, high: int) -> int:
        return data.draw(st.integers(low, high))

    norm, training = (
        data.draw(st.sampled_from(["batch", "instance", "domain"])),
        data.draw(st.booleans()),
    )
    torch.manual_seed(draw(0, 10**6))
    module, inputs, run = layer(draw, norm)
    module.double()
    for part in module.modules():
        if hasattr(part, "eps"):  # channels without variance would magnify rounding 300 times
            part.eps = 0.1
    for name, values in [*module.named_parameters(), *module.named_buffers()]:
        if name.endswith("running_var"):
            nn.init.uniform_(values, 0.5, 2)
        elif values.ndim == 1:  # weights of norms that are negative too
            nn.init.normal_(values, 0.3)
    found = []
    # an accelerator takes most layers by their formulas
    others = (as_on_device, as_on_gpu) if layer is edge_conv else ()
    forms = (nullcontext, plain, *others)
    for form in forms:
        net = copy.deepcopy(module).train(training)
        leaves = [x.clone().requires_grad_() for x in inputs]
        with form(), use_domain(net, "target"):
            out = run(net, leaves)
        (out * torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)).sum().backward()
        grads = [_of_places(x) for x in leaves] + [p.grad for p in net.parameters()]
        found.append((out.detach(), grads, list(net.buffers())))
    b, db, their_buffers = found.pop(1)
    close = {"rtol": 1e-10, "atol": 1e-10}
    size = max(float(g.abs().max()) for g in db if g is not None)
    for a, da, buffers in found:
        torch.testing.assert_close(a, b, **close)
        for mine, theirs in zip(da, db, strict=True):
            assert (mine is None) == (theirs is None)
            if mine is not None:
                torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10 * max(size, 1))
        for mine, theirs in zip(buffers, their_buffers, strict=True):
            torch.testing.assert_close(mine, theirs, **close)
