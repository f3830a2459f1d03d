import math

import pytest
import torch

from qs3.methods.pointdan import SIGMAS, PointDan, discrepancy, mmd2
from qs3.models.pointdan import pointdan


def test_discrepancy_known_answers() -> None:
    one, other = torch.tensor([[50.0, 0, 0, 0]]), torch.tensor([[0.0, 50, 0, 0]])
    assert discrepancy(one, other).item() == pytest.approx(2 / 4)
    mild = torch.tensor([[math.log(3.0), 0.0]])  # 3/4, 1/4 against 1/2, 1/2
    assert discrepancy(mild, torch.zeros(1, 2)).item() == pytest.approx(0.25)


def test_classifiers_enlarge_the_discrepancy_and_the_generator_lowers_it() -> None:
    torch.manual_seed(0)
    net = pointdan(4, nodes=8, neighbours=8).double()
    method = PointDan(class_weight=0.0, node_weight=0.0)
    method.prepare(net)
    clouds = torch.rand(3, 32, 3, dtype=torch.float64) * 2 - 1
    batch = {
        "source": {"points": clouds, "y_source": torch.tensor([0, 1, 2])},
        "target": {"points": clouds + 0.1},
        "progress": 0.5,
    }
    method.double()
    torch.manual_seed(1)
    terms = method.loss(net, batch, torch.Generator())
    terms["discrepancy"].backward()
    ours = {name: p.grad.clone() for name, p in net.named_parameters() if p.grad is not None}
    net.zero_grad()
    torch.manual_seed(1)  # the same starts of farthest point sampling
    net.backbone.with_nodes(batch["source"]["points"])
    features = net.backbone.with_nodes(batch["target"]["points"])[0].global_
    first, second = (head(features).softmax(1) for head in (net.head.first, net.head.second))
    apart = (first - second).abs().mean()
    apart.backward()
    assert terms["discrepancy"].item() == pytest.approx(-apart.item())
    alpha = math.sin(math.pi / 4)
    for name, p in net.named_parameters():
        if p.grad is None:
            continue
        sign = -1.0 if name.startswith("head") else alpha
        torch.testing.assert_close(ours[name], sign * p.grad, rtol=1e-3, atol=1e-6)


def brute_force(x, y, sigmas):
    def kernel(a, b):
        return sum(math.exp(-float((a - b).square().sum()) / (2 * s * s)) for s in sigmas)

    def mean(u, v):
        return sum(kernel(a, b) for a in u for b in v) / (len(u) * len(v))

    return mean(x, x) + mean(y, y) - 2 * mean(x, y)


def test_mmd_against_brute_force() -> None:
    torch.manual_seed(0)
    x = torch.randn(3, 7, dtype=torch.float64)
    y = torch.randn(8, 7, dtype=torch.float64) + 1
    assert mmd2(x, y, SIGMAS).item() == pytest.approx(brute_force(x, y, SIGMAS), abs=1e-10)


def test_mmd_known_answers() -> None:
    x = torch.tensor([[0.0, 0.0]])
    y = torch.tensor([[3.0, 4.0]])  # at distance 5
    assert mmd2(x, y, [5.0]).item() == pytest.approx(2 - 2 * math.exp(-0.5))
