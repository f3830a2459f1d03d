import math

import pytest
import torch
from torch.nn import functional as F

from qs3.methods.dann import Dann, dann_alpha, sine_alpha
from tests.methods.shapes import tiny_net


def _batch(progress: float = 0.3) -> dict:
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(6, 32, 3, generator=generator) * 2 - 1
    return {
        "source": {"points": clouds, "y_source": torch.tensor([0, 1, 2, 3, 0, 1])},
        "target": {"points": 0.5 * clouds.flip(0)},
        "progress": progress,
    }


@pytest.mark.parametrize("domain_batches", ["together", "apart"])
def test_against_two_backward_passes(domain_batches: str) -> None:
    """The head gets the gradient of the domain loss, the net CE's minus alpha times that."""
    net, batch = tiny_net(), _batch()
    method = Dann(0.7, 0.4, domain_batches)
    torch.manual_seed(0)
    method.prepare(net)
    assert method.domain_head is not None
    terms = method.loss(net, batch, torch.Generator())
    torch.stack(list(terms.values())).sum().backward()
    ours = [p.grad.clone() for p in net.parameters()]
    head = [p.grad.clone() for p in method.parameters()]

    source = net.features(batch["source"]["points"]).global_
    target = net.features(batch["target"]["points"]).global_
    ce = F.cross_entropy(net.head(source), batch["source"]["y_source"])
    zero, one = torch.zeros(6, dtype=torch.int64), torch.ones(6, dtype=torch.int64)
    if domain_batches == "apart":
        domain = F.cross_entropy(method.domain_head(source), zero)
        domain = domain + F.cross_entropy(method.domain_head(target), one)
    else:
        logits = method.domain_head(torch.cat([source, target]))
        domain = 2 * F.cross_entropy(logits, torch.cat([zero, one]))  # a mean over both
    weights = list(net.parameters())
    of_ce = torch.autograd.grad(ce, weights, retain_graph=True, allow_unused=True)
    of_domain = torch.autograd.grad(domain, weights, retain_graph=True, allow_unused=True)
    for mine, a, b in zip(ours, of_ce, of_domain, strict=True):
        expected = 0.7 * (0 if a is None else a) - 0.4 * dann_alpha(0.3) * (0 if b is None else b)
        torch.testing.assert_close(mine, expected, rtol=1e-4, atol=1e-6)
    for mine, theirs in zip(head, torch.autograd.grad(domain, method.parameters()), strict=True):
        torch.testing.assert_close(mine, 0.4 * theirs, rtol=1e-4, atol=1e-6)


def test_a_head_that_knows_nothing_pays_2_ln_2() -> None:
    method, net = Dann(), tiny_net()
    method.prepare(net)
    last = [m for m in method.modules() if isinstance(m, torch.nn.Linear)][-1]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    terms = method.loss(net, _batch(), torch.Generator())
    assert terms["domain"].item() == pytest.approx(2 * math.log(2))


def test_schedules() -> None:
    assert dann_alpha(0.0) == 0.0
    assert dann_alpha(0.1) == pytest.approx((math.e - 1) / (math.e + 1))
    assert dann_alpha(math.log(3) / 10) == pytest.approx(0.5)
    assert dann_alpha(1.0) == pytest.approx(0.9999092, abs=1e-7)
    assert [sine_alpha(p) for p in (0.0, 1 / 3, 1.0)] == pytest.approx([0.0, 0.5, 1.0])
