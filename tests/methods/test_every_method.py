"""What holds for each method: gradients, chance, precision, and what a step asks of a device."""

from __future__ import annotations

import copy
import inspect
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra.utils import get_class
from torch import nn

from qs3.methods.base import Method
from qs3.models.base import ClassHead, PointClassifier
from qs3.models.dgcnn import DGCNN, dgcnn
from qs3.models.pointdan import pointdan
from tests.device import Watch
from tests.methods.cases import CASES, batch_of, total
from tests.methods.shapes import CLASSES, tiny_net, tiny_pointdan

LEARNING = [
    *("source_only", "pcm", "dann", "defrec", "defrec_pcm", "gast", "gast_pcm"),
    *("pointdan", "cpcm", "mlsp", "sd", "pcfea_styled", "student_lrent"),
]
WITHOUT_CHANCE = ("source_only", "dann", "pointdan", "pcfea_styled", "student_lrent")
QUICK = {"pcm", "pointdan", "gast", "student", "dann", "supervised"}
each = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in CASES]
)


def _made(name: str) -> tuple[nn.Module, Method, dict[str, Any]]:
    torch.manual_seed(0)
    if name == "pointdan":
        net = pointdan(4, nodes=8, neighbours=8)
    else:
        backbone = DGCNN(k=4, widths=(8, 8, 8, 16), embedding=32)
        net = PointClassifier(backbone, ClassHead(64, 4, hidden=(16,), dropout=0.0))
    method = CASES[name].make()
    method.prepare(net)
    return net, method, batch_of(CASES[name], method, 4, 48, 4)


def _total(net: nn.Module, method: Method, batch: dict[str, Any], seed: int = 0) -> torch.Tensor:
    torch.manual_seed(5)  # dropout, and PointDAN's starts
    return total(method, net, batch, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", LEARNING)
def test_gradients_reach_every_weight(name: str) -> None:
    net, method, batch = _made(name)
    _total(net, method, batch).backward()
    for key, p in [*net.named_parameters(), *method.named_parameters()]:
        assert (p.grad is not None) == p.requires_grad, key  # a teacher asks for none
        assert p.grad is None or p.grad.isfinite().all(), key
    assert next(net.backbone.parameters()).grad.any()


@pytest.mark.parametrize("name", LEARNING)
def test_a_step_is_a_function_of_the_generator(name: str) -> None:
    """And leaves its batch alone."""
    net, method, batch = _made(name)
    given = copy.deepcopy(batch)
    values = [_total(copy.deepcopy(net), copy.deepcopy(method), batch, seed) for seed in (0, 0, 1)]
    assert torch.equal(values[0], values[1])
    assert torch.equal(values[0], values[2]) == (name in WITHOUT_CHANCE)
    for domain in {"source", "target"} & given.keys():
        assert all(torch.equal(batch[domain][k], value) for k, value in given[domain].items())


@pytest.mark.parametrize("name", LEARNING)
def test_half_precision(name: str) -> None:
    """Under autocast the loss is about the same, and finite gradients come back in float32."""
    net, method, batch = _made(name)
    full = _total(copy.deepcopy(net), copy.deepcopy(method), batch)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = _total(net, method, batch)
    half.backward()
    assert half.item() == pytest.approx(full.item(), rel=0.15)
    grads = [p.grad for p in (*net.parameters(), *method.parameters()) if p.grad is not None]
    assert all(grad.dtype == torch.float32 and grad.isfinite().all() for grad in grads)


def test_defaults_are_those_of_the_configs() -> None:
    """`Gast()` in a notebook is `method=gast`."""
    for path in (Path(__file__).parents[2] / "conf" / "method").glob("*.yaml"):
        written = yaml.safe_load(path.read_text())
        if "_target_" in written and path.stem != "own":  # a user's
            taken = inspect.signature(get_class(written.pop("_target_"))).parameters.values()
            assert {p.name: p.default for p in taken if p.default is not p.empty} == written


def _tiny(name: str, device: str = "cpu") -> tuple[nn.Module, Method]:
    net, method = tiny_pointdan() if name == "pointdan" else tiny_net(), CASES[name].make()
    method.prepare(net)
    return net.to(device), method.to(device)


def _watched(name: str, net: nn.Module, method: Method, b: int, n: int) -> Watch:
    """Forward and backward of one step on the device without values of `tests.device`."""
    batch = batch_of(CASES[name], method, b, n, CLASSES, "meta")
    with Watch() as watch:
        total(method, net, batch, torch.Generator().manual_seed(0)).backward()
    assert watch.carried == []
    return watch


@each
def test_no_value_is_asked_for_and_operations_do_not_grow_with_the_batch(name: str) -> None:
    few, many = (_watched(name, *_tiny(name, "meta"), b, 64) for b in (4, 8))
    assert few.counts == many.counts
    assert sum(few.counts.values()) > 20  # it did watch


@cache
def _kernels(name: str, own_net: bool) -> int:
    """Of a step of 16 x 1,024 points with DGCNN, or with PointDAN's own net."""
    method, net = CASES[name].make(), pointdan(CLASSES) if own_net else dgcnn(CLASSES)
    method.prepare(net)
    return _watched(name, net.to("meta"), method.to("meta"), 16, 1024).kernels.total()


@each
def test_kernels_are_those_of_the_passes_and_as_many_again_at_most(name: str) -> None:
    passes = CASES[name].passes * _kernels("source_only", name == "pointdan")
    assert passes <= _kernels(name, name == "pointdan") <= 2 * passes


@each
def test_as_many_passes_as_stated(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The benchmark compares with them; a pass is a call of the backbone."""
    net, method = _tiny(name)
    calls, real = [], "with_nodes" if name == "pointdan" else "forward"
    call = getattr(net.backbone, real)
    monkeypatch.setattr(net.backbone, real, lambda *args: calls.append(0) or call(*args))
    batch = batch_of(CASES[name], method, 4, 64, CLASSES)
    total(method, net, batch, torch.Generator().manual_seed(0))
    assert len(calls) == CASES[name].passes


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@each
def test_a_gpu_is_never_waited_for(name: str) -> None:
    net, method = _tiny(name, "cuda")
    batch = batch_of(CASES[name], method, 4, 64, CLASSES, "cuda")
    generator = torch.Generator("cuda").manual_seed(0)
    total(method, net, batch, generator).backward()  # loads libraries, which waits
    with warnings.catch_warnings():  # torch says that the mode is new
        warnings.simplefilter("ignore", UserWarning)
        torch.cuda.set_sync_debug_mode("error")
    try:
        total(method, net, batch, generator).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
