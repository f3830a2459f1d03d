"""What a training step of each net asks of an accelerator: few kernels, and no value.

16 clouds of 1,024 points, forward and backward, without the optimiser; see `tests.device`.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch.nn import functional as F

from qs3.kernels.norms import use_domain
from qs3.models.base import PointClassifier
from tests.device import Watch, as_on_device, as_on_gpu
from tests.models.test_all_nets import NETS, UNDROPPED, build, clouds

# Kernels of a step. The authors' DGCNN has 167.
BARS = {
    "committee": 400,
    "dgcnn": 190,
    "frontview": 220,
    "pointdan": 350,
    "pointnet": 180,
    "pointnet2": 450,
    "rscnn": 250,
    "simpleview": 230,
}


def _step(net: PointClassifier, points: torch.Tensor) -> Watch:
    labels = torch.arange(len(points), device=points.device) % 5
    with Watch() as watch, use_domain(net, "target"):
        F.cross_entropy(net(points), labels).backward()
    return watch


@pytest.mark.parametrize("name", NETS)
def test_kernels_of_a_step(name: str) -> None:
    net = build(name).float().train().to("meta")
    watch = _step(net, torch.empty(16, 1024, 3, device="meta"))
    assert watch.carried == []
    assert 100 < watch.kernels.total() <= BARS[name]


@pytest.mark.parametrize(
    "name", ["dgcnn", *(pytest.param(n, marks=pytest.mark.slow) for n in NETS if n != "dgcnn")]
)
@pytest.mark.parametrize("training", [True, False])
def test_the_way_of_a_device_is_that_of_the_cpu(name: str, training: bool) -> None:
    settings: dict[str, Any] = {} if name in UNDROPPED else {"dropout": 0.0}
    if name == "simpleview":
        settings["image_size"] = 24
    net, points = build(name, **settings), clouds(2, 40 if name == "dgcnn" else 600)
    torch.manual_seed(1)
    net.train(training)
    for part in net.modules():
        if hasattr(part, "eps"):  # two clouds that agree would magnify rounding 300 times
            part.eps = 0.1
    state = {key: value.clone() for key, value in net.state_dict().items()}
    found = []
    for way in (nullcontext, as_on_device, as_on_gpu):
        net.load_state_dict(state)
        net.zero_grad()
        torch.manual_seed(2)
        with way():
            out = net(points)
        F.cross_entropy(out, torch.arange(2)).backward()
        grads = [p.grad.clone() for p in net.parameters() if p.grad is not None]
        buffers = [value.clone() for value in net.buffers()]
        found.append((out.detach(), grads, buffers))
    for mine, theirs, by_triton in zip(*found, strict=True):
        torch.testing.assert_close(mine, by_triton, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(mine, theirs, rtol=1e-7, atol=1e-9)
