"""Passes as graphs: what is kept apart, and that a step's figures stay as they are.

A graph's memory is played: one input, one set of outputs, of activations and of gradients for all
calls, each written over by the next. What a GPU makes of them: test_captured_passes.
"""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call

from qs3 import kernels as fast
from qs3.engine import cuda_graphs
from qs3.engine.cuda_graphs import EAGER, Graphs
from qs3.errors import DataError
from qs3.kernels.norms import use_domain
from qs3.models.dgcnn import dgcnn
from tests.methods.cases import CASES, batch_of, total
from tests.methods.shapes import CLASSES, tiny_net, tiny_pointdan


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
                found = torch.autograd.grad(one.outputs, one.weights, grads, allow_unused=True)
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
    """Losses, weights and statistics of three steps of one batch size and one of another."""
    torch.manual_seed(0)
    net = tiny_pointdan() if name == "pointdan" else tiny_net()
    method = CASES[name].make()
    method.prepare(net)
    optimizer = torch.optim.Adam([*net.parameters(), *method.parameters()], lr=1e-2)
    made = Graphs(net, Played) if graphs else None
    found = {}
    for step, b in enumerate((6, 6, 6, 4)):
        if made is not None:
            made.begin_step()
        batch = batch_of(CASES[name], method, b, 32, CLASSES)
        generator = torch.Generator().manual_seed(step)
        optimizer.zero_grad()
        loss = total(method, made.stand_in if made else net, batch, generator)
        loss.backward()
        optimizer.step()
        found[f"loss {step}"] = loss.detach()
    return found | net.state_dict() | method.state_dict()


def test_a_pass_is_captured_once_it_has_come_often() -> None:
    graphs = Graphs(tiny_net(), Played)
    for step in range(EAGER + 3):
        graphs.begin_step()
        graphs.stand_in(torch.randn(4, 16, 3))
        assert Played.made == (step >= EAGER)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pass is captured when it comes the first time."""
    monkeypatch.setattr(cuda_graphs, "EAGER", 0)


@pytest.mark.usefixtures("at_once")
def test_passes_of_a_step_have_graphs_of_their_own() -> None:
    plain = tiny_net()
    graphs = Graphs(copy.deepcopy(plain), Played)
    net = graphs.stand_in
    first, second = torch.randn(4, 16, 3), torch.randn(4, 16, 3)
    for _ in range(2):
        graphs.begin_step()
        for one in (net, plain):
            torch.manual_seed(0)
            one.zero_grad()
            (one(first) * one(second)).sum().backward()
        for p, q in zip(net.parameters(), plain.parameters(), strict=True):
            assert torch.equal(p.grad, q.grad)
    assert Played.made == 2


@pytest.mark.usefixtures("at_once")
def test_a_pass_goes_back_once_and_in_its_own_step() -> None:
    graphs = Graphs(tiny_net(), Played)
    loss = graphs.stand_in(torch.randn(4, 16, 3)).sum()
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match=r"set trainer\.cuda_graphs=false"):
        loss.backward()
    late = graphs.stand_in(torch.randn(4, 16, 3)).sum()
    graphs.begin_step()
    graphs.stand_in(torch.randn(4, 16, 3))
    graphs.stand_in(torch.randn(4, 16, 3))
    with pytest.raises(RuntimeError, match="goes back once"):
        late.backward()


@pytest.mark.usefixtures("at_once")
def test_whatever_a_graph_depends_on_has_its_own() -> None:
    plain = dgcnn(4, k=4, norm="domain")
    graphs, points = Graphs(plain, Played), torch.randn(4, 16, 3)
    net = graphs.stand_in

    def made(points: Tensor = points) -> int:
        before = Played.made
        for _ in range(2):  # the second time it is there
            graphs.begin_step()
            net(points)
        return Played.made - before

    assert made() == 1
    with use_domain(net, "target"):
        assert made() == 1
    assert made() == 0
    plain.head[1].source.momentum = 0.5
    assert made() == 1
    plain.head[1].eval()
    assert made() == 1
    plain.head[3].p = 0.2
    assert made() == 1
    plain.backbone.k = 5
    assert made() == 1
    plain.backbone.requires_grad_(False)
    assert made() == 1
    with fast.plain():
        assert made() == 1
    assert made(points.mT.contiguous().mT) == 1
    assert made(points[:, :8]) == 1
    assert made() == 0
    graphs.forget()
    assert made() == 1


@pytest.mark.usefixtures("at_once")
def test_other_weights_are_not_replayed() -> None:
    """Those in a net's place for one pass, and a layer or a buffer that took another's."""
    plain, points = tiny_net(), torch.randn(4, 16, 3)
    graphs = Graphs(plain, Played)
    net = graphs.stand_in
    expected = plain.eval()(points)
    plain.train()
    zeros = {name: torch.zeros_like(p) for name, p in plain.named_parameters()}
    net(points)
    graphs.begin_step()
    assert not functional_call(net, zeros, (points,)).any()
    assert Played.made == 1
    graphs.begin_step()
    net(points)
    assert Played.made == 1
    plain.head.append(nn.Identity())
    graphs.begin_step()
    net(points)
    del plain.head[-1]
    norm = next(m for m in plain.modules() if isinstance(m, nn.BatchNorm1d))
    norm.running_mean = norm.running_mean.clone()
    graphs.begin_step()
    before = norm.running_mean.clone()
    net(points)
    assert not torch.equal(norm.running_mean, before)
    assert Played.made == 1
    assert expected.shape == net.eval()(points).shape


@pytest.mark.usefixtures("at_once")
def test_other_passes_are_made_as_usual() -> None:
    net, points = Graphs(tiny_net(), Played).stand_in, torch.randn(4, 16, 3)
    net.eval()
    net(points)
    net.train()
    with torch.no_grad():
        net(points)
    with torch.autocast("cpu"):
        net(points)
    net(points.clone().requires_grad_()).sum().backward()
    for register in ("register_forward_hook", "register_full_backward_pre_hook"):
        handle = getattr(net.backbone, register)(lambda *_: None)
        net(points), net.features(points)
        handle.remove()
    assert Played.made == 0
    net(points), net.features(points)
    assert Played.made == 2


@pytest.mark.usefixtures("at_once")
def test_what_cannot_be_captured_goes_on_without(caplog: pytest.LogCaptureFixture) -> None:
    """Nor are the graphs that there are replayed any longer: torch's generator is another one."""

    def refused(module: nn.Module, points: Tensor) -> Any:
        if len(points) == 4:
            return Played(module, points)
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    graphs = Graphs(tiny_net(), refused)
    net = graphs.stand_in
    pending = net.features(torch.randn(4, 16, 3)).global_
    net(torch.randn(4, 16, 3))
    assert net(torch.randn(5, 16, 3)).requires_grad
    assert graphs.off
    assert not graphs.whole.graphs
    assert not graphs.backbone.graphs
    pending.sum().backward()
    assert net(torch.randn(4, 16, 3)).requires_grad
    assert net.features(torch.randn(4, 16, 3)).global_.requires_grad
    assert Played.made == 2
    assert len(caplog.records) == 1


def test_the_stand_in_is_the_net_but_for_its_passes() -> None:
    plain = tiny_net()
    net = Graphs(plain).stand_in
    assert isinstance(net, type(plain))
    assert dict(net.named_parameters()) == dict(plain.named_parameters())
    net.head = nn.Linear(plain.backbone.feature_dim, 7)
    assert plain(torch.randn(4, 16, 3)).shape == (4, 7)
    for copied in (copy.deepcopy(net), copy.copy(net)):
        assert type(copied) is type(plain)
        assert copied is not plain
    with pytest.raises(DataError, match="NaN"):
        net.features(torch.full((1, 1, 3), 0.0).index_fill(2, torch.tensor([0]), float("nan")))
