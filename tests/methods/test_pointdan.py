import math

import pytest
import torch
from torch.nn import functional as F

from qs3.methods.pointdan import SIGMAS, PointDan, discrepancy, mmd2
from qs3.models.pointdan import pointdan


def test_discrepancy_known_answers() -> None:
    one, other = torch.tensor([[50.0, 0, 0, 0]]), torch.tensor([[0.0, 50, 0, 0]])
    assert discrepancy(one, other).item() == pytest.approx(2 / 4)
    assert discrepancy(one, one).item() == 0
    mild = torch.tensor([[math.log(3.0), 0.0]])  # 3/4, 1/4 against 1/2, 1/2
    assert discrepancy(mild, torch.zeros(1, 2)).item() == pytest.approx(0.25)


def _setting(**settings):
    torch.manual_seed(0)
    net = pointdan(4, nodes=8, neighbours=8).double()
    method = PointDan(**settings)
    method.prepare(net)
    method.double()
    clouds = torch.rand(3, 32, 3, dtype=torch.float64) * 2 - 1
    batch = {
        "source": {"points": clouds, "y_source": torch.tensor([0, 1, 2])},
        "target": {"points": clouds + 0.1},
        "progress": 0.5,
    }
    return net, method, batch


def test_classifiers_enlarge_the_discrepancy_and_the_generator_lowers_it() -> None:
    net, method, batch = _setting(class_weight=0.0, node_weight=0.0)
    torch.manual_seed(1)
    terms = method.loss(net, batch, torch.Generator())
    terms["discrepancy"].backward()
    ours = {name: p.grad.clone() for name, p in net.named_parameters() if p.grad is not None}
    net.zero_grad()
    torch.manual_seed(1)  # the same starts of farthest point sampling
    net.backbone.with_nodes(batch["source"]["points"])
    features = net.backbone.with_nodes(batch["target"]["points"])[0].global_
    apart = (
        (F.softmax(net.head.first(features), 1) - F.softmax(net.head.second(features), 1))
        .abs()
        .mean()
    )
    apart.backward()
    assert terms["discrepancy"].item() == pytest.approx(-apart.item())
    alpha = math.sin(math.pi / 4)
    for name, p in net.named_parameters():
        if p.grad is None:
            continue
        sign = -1.0 if name.startswith("head") else alpha
        torch.testing.assert_close(ours[name], sign * p.grad, rtol=1e-3, atol=1e-6)


def test_attention_belongs_to_a_domain() -> None:
    net, method, batch = _setting(class_weight=0.0, discrepancy_weight=0.0)
    method.loss(net, batch, torch.Generator())["nodes"].backward()
    assert method.attention is not None
    for domain in ("source", "target"):
        assert all(p.grad is not None for p in method.attention[domain].parameters())
    assert net.head.first.weight.grad is None
    assert net.backbone.node_module.residual.layers[0].weight.grad.abs().max() > 0


def brute_force(x, y, sigmas):
    def kernel(a, b):
        return sum(math.exp(-float((a - b).square().sum()) / (2 * s * s)) for s in sigmas)

    def mean(u, v):
        return sum(kernel(a, b) for a in u for b in v) / (len(u) * len(v))

    return mean(x, x) + mean(y, y) - 2 * mean(x, y)


@pytest.mark.parametrize("sizes", [(5, 5), (3, 8), (1, 1)])
def test_mmd_against_brute_force(sizes: tuple[int, int]) -> None:
    torch.manual_seed(0)
    x = torch.randn(sizes[0], 7, dtype=torch.float64)
    y = torch.randn(sizes[1], 7, dtype=torch.float64) + 1
    assert mmd2(x, y, SIGMAS).item() == pytest.approx(brute_force(x, y, SIGMAS), abs=1e-10)


def test_mmd_known_answers() -> None:
    x = torch.tensor([[0.0, 0.0]])
    y = torch.tensor([[3.0, 4.0]])  # at distance 5
    assert mmd2(x, y, [5.0]).item() == pytest.approx(2 - 2 * math.exp(-0.5))
    assert mmd2(x, x, SIGMAS).item() == 0
    far = torch.full((1, 2), 1e6)
    assert mmd2(x, far, SIGMAS).item() == pytest.approx(2 * len(SIGMAS))
