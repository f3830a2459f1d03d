"""Passes as graphs: what is kept apart, and that a step's figures stay as they are.

Without a GPU a graph's memory is played: one input, one set of outputs, of activations and of
gradients for all calls, each written over by the next.
"""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from qs3.engine import cuda_graphs
from qs3.engine.cuda_graphs import EAGER, GraphedNet
from qs3.models.dgcnn import dgcnn
from qs3.models.norms import use_domain
from qs3.models.pointnet import pointnet
from tests.methods.cases import CASES, batch_of, total
from tests.methods.shapes import CLASSES, tiny_net, tiny_pointdan

GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


class Played:
    """What a captured pass does with its memory."""

    made = 0

    def __init__(self, module: nn.Module, points: Tensor) -> None:
        Played.made += 1
        self.module, self.points = module, points.clone()
        self.weights = [p for p in module.parameters() if p.requires_grad]
        self.places: list[Tensor] = []
        self.grads: list[Tensor] = []

    def __call__(self, points: Tensor) -> tuple[Tensor, ...]:
        one = self

        class Pass(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, given: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
                one.points.copy_(given)
                with torch.enable_grad():
                    one.outputs = one.module(one.points)
                one.places = one.places or [torch.empty_like(o) for o in one.outputs]
                for place, value in zip(one.places, one.outputs, strict=True):
                    place.detach().copy_(value.detach())
                return tuple(place.detach() for place in one.places)

            @staticmethod
            def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
                found = torch.autograd.grad(
                    one.outputs, one.weights, grads, allow_unused=True, retain_graph=True
                )
                one.grads = one.grads or [torch.zeros_like(w) for w in one.weights]
                for place, value in zip(one.grads, found, strict=True):
                    if value is not None:
                        place.copy_(value)
                kept = zip(one.grads, found, strict=True)
                return None, *(None if value is None else g.detach() for g, value in kept)

        return Pass.apply(points, *self.weights)  # type: ignore[no-any-return]


@pytest.fixture(autouse=True)
def counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Played, "made", 0)


@pytest.mark.parametrize("name", CASES)
def test_steps_of_every_method_are_those_without_graphs(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 1)
    one = _trained(name, graphs=False)
    other = _trained(name, graphs=True)
    assert Played.made > 0 or name == "pointdan"  # whose net is asked for its nodes
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)


def _trained(name: str, *, graphs: bool) -> dict[str, Tensor]:
    """Losses, weights and statistics of four steps of one batch size and one of another."""
    torch.manual_seed(0)
    net = tiny_pointdan() if name == "pointdan" else tiny_net()
    method = CASES[name].make()
    method.prepare(net)
    optimizer = torch.optim.Adam([*net.parameters(), *method.parameters()], lr=1e-2)
    stand_in = GraphedNet(net, Played) if graphs else None
    found = {}
    for step, b in enumerate((6, 6, 6, 6, 4)):
        if stand_in is not None:
            stand_in.begin_step()
        batch = batch_of(CASES[name], method, b, 32, CLASSES)
        generator = torch.Generator().manual_seed(step)
        optimizer.zero_grad()
        loss = total(method, stand_in or net, batch, generator)
        loss.backward()
        optimizer.step()
        found[f"loss {step}"] = loss.detach()
    return found | net.state_dict() | method.state_dict()


def test_a_pass_is_captured_once_it_has_come_often() -> None:
    net = GraphedNet(tiny_net(), Played)
    for step in range(EAGER + 3):
        net.begin_step()
        net(torch.randn(4, 16, 3))
        assert Played.made == (step >= EAGER)


def test_passes_of_a_step_have_graphs_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)
    plain = tiny_net()
    net = GraphedNet(copy.deepcopy(plain), Played)
    first, second = torch.randn(4, 16, 3), torch.randn(4, 16, 3)
    for _ in range(2):
        net.begin_step()
        for one in (net, plain):
            torch.manual_seed(0)
            one.zero_grad()
            (one(first) * one(second)).sum().backward()
        for p, q in zip(net.parameters(), plain.parameters(), strict=True):
            assert torch.equal(p.grad, q.grad)
    assert Played.made == 2


def test_what_a_method_keeps_is_not_written_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)
    net = GraphedNet(tiny_net(), Played)
    kept = net.features(torch.randn(4, 16, 3)).global_.detach()
    value = kept.clone()
    net.begin_step()
    net.features(torch.randn(4, 16, 3))
    assert Played.made == 1
    assert torch.equal(kept, value)


def test_whatever_a_graph_depends_on_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)
    plain = dgcnn(4, k=4, norm="domain")
    net, points = GraphedNet(plain, Played), torch.randn(4, 16, 3)

    def graphs() -> int:
        before = Played.made
        for _ in range(2):  # the second time it is there
            net.begin_step()
            net(points)
        return Played.made - before

    assert graphs() == 1
    with use_domain(net, "target"):  # type: ignore[arg-type]
        assert graphs() == 1
    assert graphs() == 0
    plain.head[1].source.momentum = 0.5  # type: ignore[union-attr]
    assert graphs() == 1
    plain.head[1].eval()  # type: ignore[operator]
    assert graphs() == 1
    plain.backbone.requires_grad_(False)
    assert graphs() == 1
    net.forget()
    assert graphs() == 1


def test_other_passes_are_made_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)
    net, points = GraphedNet(tiny_net(), Played), torch.randn(4, 16, 3)
    net.eval()
    net(points)
    net.train()
    with torch.no_grad():
        net(points)
    with torch.autocast("cpu"):
        net(points)
    net(points.clone().requires_grad_()).sum().backward()
    handle = net.backbone.register_forward_hook(lambda *_: None)
    net(points), net.features(points)
    handle.remove()
    assert Played.made == 0
    net(points), net.features(points)
    assert Played.made == 2


def test_what_cannot_be_captured_goes_on_without(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)

    def refused(module: nn.Module, points: Tensor) -> Any:
        raise RuntimeError("operation not permitted when stream is capturing")

    net = GraphedNet(tiny_net(), refused)
    for _ in range(2):
        assert net(torch.randn(4, 16, 3)).requires_grad
    assert [record.message for record in caplog.records] == [
        "no CUDA graphs of this net, steps go on without (operation not permitted when stream is "
        "capturing)"
    ]


def test_a_copy_is_of_the_net() -> None:
    plain = tiny_net()
    copied = copy.deepcopy(GraphedNet(plain))
    assert type(copied) is type(plain)
    assert copied is not plain


@GPU
@pytest.mark.parametrize("norm", ["batch", "domain"])
@pytest.mark.parametrize("build", [dgcnn, pointnet])
def test_a_gpu_s_graphs_are_those_steps_to_the_bit(build: Any, norm: str) -> None:
    """Where no sum depends on an order: weights, statistics and what is drawn afterwards."""
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        one, other = (_steps_on_a_gpu(build, norm, graphs) for graphs in (False, True))
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(one[key], other[key]) for key in one)


@GPU
def test_a_gpu_goes_on_after_a_capture_that_failed(caplog: pytest.LogCaptureFixture) -> None:
    class Asks(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x * (1.0 if x.sum().item() > 0 else 2.0)

    torch.manual_seed(0)
    plain = tiny_net().cuda()
    plain.head = nn.Sequential(plain.head, Asks())
    net = GraphedNet(copy.deepcopy(plain))
    found = []
    for one in (net, plain):
        torch.manual_seed(0)
        for _ in range(EAGER + 3):
            net.begin_step()
            points = torch.rand(4, 16, 3, device="cuda")
            one(points).sum().backward()
        found.append({**one.state_dict(), "drawn": torch.rand(4, device="cuda")})
    assert [record.message[:30] for record in caplog.records] == ["no CUDA graphs of this net, st"]
    assert torch.cuda.current_stream() == torch.cuda.default_stream()
    assert all(torch.equal(found[0][key], found[1][key]) for key in found[1])


def _steps_on_a_gpu(build: Any, norm: str, graphs: bool) -> dict[str, Tensor]:
    torch.manual_seed(0)
    net = build(10, norm=norm).cuda().train()
    optimizer = torch.optim.Adam(net.parameters())
    stand_in = GraphedNet(net)
    generator = torch.Generator("cuda").manual_seed(0)
    for _ in range(EAGER + 6):
        optimizer.zero_grad()
        stand_in.begin_step()
        passes: Any = stand_in if graphs else net
        for domain in ("source", "target"):
            points = torch.rand(8, 256, 3, device="cuda", generator=generator)
            labels = torch.randint(10, (8,), device="cuda", generator=generator)
            with use_domain(net, domain):
                nn.functional.cross_entropy(passes(points), labels).backward()
        optimizer.step()
    assert bool(stand_in._whole.graphs) == graphs
    return {**net.state_dict(), "drawn": torch.rand(4, device="cuda")}
