"""Losses on frozen features: each term teaches the head, or the method is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
import torch

from qs3.errors import ConfigError
from qs3.methods.base import Method
from qs3.models.base import PointClassifier
from qs3.models.features import features
from qs3.selftraining.pcfea import Pcfea
from tests.methods.cases import CASES, Case, batch_of
from tests.methods.shapes import CLASSES
from tests.models.onnx_files import write_encoder

REFUSED = {"defrec", "defrec_on_source", "defrec_pcm", "mlsp"}  # these need features of points
REFUSED |= {"dann", "dann_apart", "sd", "gast", "gast_pcm"}  # these train features


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_encoder(tmp_path_factory.mktemp("frozen") / "net.onnx", dim=16)


def _net(file: Path, *hidden: int) -> PointClassifier:
    torch.manual_seed(0)
    return features(CLASSES, str(file), hashlib.sha256(file.read_bytes()).hexdigest(), hidden)


def _taught(net: Any, method: Method, case: Case) -> dict[str, bool]:
    """Whether each term's gradient reaches a weight of the net."""
    batch = batch_of(case, method, 8, 64, CLASSES)
    terms = method.loss(net, batch, torch.Generator().manual_seed(0))
    weights = list(net.parameters())
    return {
        name: term.requires_grad and any(g is not None for g in _gradients(term, weights))
        for name, term in terms.items()
    }


def _gradients(term: torch.Tensor, weights: list[Any]) -> tuple[torch.Tensor | None, ...]:
    return torch.autograd.grad(term, weights, retain_graph=True, allow_unused=True)


@pytest.mark.parametrize("name", sorted(CASES.keys() - {"pointdan"}))
def test_each_term_teaches_the_head_or_the_method_is_refused(name: str, file: Path) -> None:
    net, method = _net(file, 8), CASES[name].make()
    if name in REFUSED:
        with pytest.raises(ConfigError):
            method.prepare(net)
        return
    method.prepare(net)
    taught = _taught(net, method, CASES[name])
    assert taught
    assert all(taught.values()), taught


def test_pcfea_aligns_what_the_head_s_last_layer_is_given(file: Path) -> None:
    """Of a linear probe that is the frozen vector, which styling alone can teach."""
    net, method = _net(file), Pcfea(align_weight=0.0)
    method.prepare(net)
    method.styled = True
    assert _taught(net, method, CASES["pcfea"]) == {"ce": True}
