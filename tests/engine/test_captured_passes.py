"""Passes as graphs that a GPU captured: steps to the bit, memory that comes back, failures."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from qs3.engine.cuda_graphs import EAGER, Graphs
from qs3.kernels.norms import use_domain
from tests.models.test_all_nets import NETS, build

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def test_forgotten_graphs_give_their_memory_back() -> None:
    net, points = build("dgcnn").float().cuda().train(), torch.rand(16, 512, 3).cuda()

    def reserved(steps: int) -> int:
        for _ in range(steps):
            graphs.begin_step()
            net.zero_grad()
            graphs.stand_in(points).sum().backward()
        torch.cuda.empty_cache()
        return torch.cuda.memory_reserved()

    graphs = Graphs(net)
    before = reserved(1)
    kept = reserved(EAGER + 2)
    graphs.forget()
    assert torch.cuda.memory_reserved() - before < (kept - before) / 2


@pytest.mark.parametrize("features", [False, True])
@pytest.mark.parametrize("norm", ["batch", "domain"])
@pytest.mark.parametrize("name", NETS)
def test_a_gpu_s_graphs_are_those_steps_to_the_bit(name: str, norm: str, features: bool) -> None:
    """Weights, statistics and what is drawn afterwards; nearly so of nets that differ by chance."""
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        one, again, other = (
            _steps_on_a_gpu(name, norm, features, graphs) for graphs in (False, False, True)
        )
    finally:
        torch.use_deterministic_algorithms(False)
    same = all(torch.equal(one[key], again[key]) for key in one)
    assert same or name not in ("dgcnn", "pointnet")
    for key, value in one.items():
        if same:
            assert torch.equal(value, other[key]), key
        else:
            torch.testing.assert_close(value, other[key], rtol=1e-3, atol=1e-3)


def test_a_gpu_goes_on_after_a_capture_that_failed(caplog: pytest.LogCaptureFixture) -> None:
    """Passes of features are captured; those of the whole net ask for a value."""

    class Asks(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x * (1.0 if x.sum().item() > 0 else 2.0)

    torch.manual_seed(0)
    plain = build("dgcnn").float().cuda().train()
    plain.head = nn.Sequential(plain.head, Asks())
    graphs = Graphs(copy.deepcopy(plain))
    found = []
    for one in (graphs.stand_in, plain):
        torch.manual_seed(0)
        for _ in range(EAGER + 3):
            graphs.begin_step()
            points = torch.rand(4, 64, 3, device="cuda")
            one.features(points).global_.sum().backward()
            one(points).sum().backward()
        found.append({**one.state_dict(), "drawn": torch.rand(4, device="cuda")})
    assert [record.message[:30] for record in caplog.records] == ["no CUDA graphs of this net, st"]
    assert torch.cuda.current_stream() == torch.cuda.default_stream()
    assert all(torch.equal(found[0][key], found[1][key]) for key in found[1])


def _steps_on_a_gpu(name: str, norm: str, features: bool, graphs: bool) -> dict[str, Tensor]:
    """Some steps of two domains' passes, by the features alone or by the whole net."""
    torch.manual_seed(0)
    net = build(name, norm=norm).float().cuda().train()
    optimizer = torch.optim.Adam(net.parameters())
    made = Graphs(net)
    generator = torch.Generator("cuda").manual_seed(0)
    for _ in range(EAGER + 6):
        optimizer.zero_grad()
        made.begin_step()
        passes: Any = made.stand_in if graphs else net
        losses = []
        for domain in ("source", "target"):
            points = torch.rand(8, 256, 3, device="cuda", generator=generator)
            labels = torch.randint(5, (8,), device="cuda", generator=generator)
            with use_domain(net, domain):
                logits = net.head(passes.features(points).global_) if features else passes(points)
            losses.append(nn.functional.cross_entropy(logits, labels))
        sum(losses).backward()
        optimizer.step()
    assert bool((made.backbone if features else made.whole).graphs) == graphs
    return {**net.state_dict(), "drawn": torch.rand(4, device="cuda")}
