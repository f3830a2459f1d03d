"""The classifier around a method: heads, progress, learning rates."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch

from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.methods.bounds import SourceOnly
from qs3.methods.dann import Dann
from qs3.methods.gast import Gast
from qs3.methods.pointdan import PointDan
from qs3.methods.sd import Sd
from qs3.models.pointdan import pointdan
from qs3.selftraining.student import Student
from tests.methods.shapes import tiny_net


def _classifier(method: Any, seed: int = 0, **more: Any) -> Classifier:
    settings = {
        "build_net": lambda: tiny_net(torch.initial_seed()),
        "build_optimizer": partial(torch.optim.Adam, lr=1e-3),
        **more,
    }
    return Classifier(**settings, method=method, student=Student(), phases=Phases(4), seed=seed)


def test_heads_are_a_function_of_the_seed() -> None:
    made = []
    for seed in (0, 0, 1):
        torch.rand(7)  # whatever was drawn before
        made.append(_classifier(Gast(), seed).method.state_dict())
    first, again, other = made
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not all(torch.equal(first[key], other[key]) for key in first)


def test_heads_change_neither_the_net_nor_torch_s_generator() -> None:
    torch.manual_seed(0)
    plain = _classifier(SourceOnly()).net.state_dict()
    state = torch.get_rng_state()
    headed = _classifier(Dann()).net.state_dict()
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(plain[key], headed[key]) for key in plain)


def test_a_method_s_copy_of_the_net_has_no_hooks_and_does_not_learn() -> None:
    """Or the copy's passes would be in the regulariser; and the hook would take all else along."""
    classifier = _classifier(Sd(), regulariser_weight=0.1)
    teacher = classifier.method.teacher
    assert classifier.net.backbone._forward_hooks
    assert not any(module._forward_hooks for module in teacher.modules())
    optimizer = classifier.configure_optimizers()[0][0]
    before = {key: value.clone() for key, value in teacher.state_dict().items()}
    classifier.net(torch.randn(4, 16, 3)).sum().backward()
    optimizer.step()
    assert all(torch.equal(value, before[key]) for key, value in teacher.state_dict().items())
    names = classifier.state_dict().keys()  # a checkpoint holds it
    assert {"method.steps", "method.teacher.head.0.weight"} <= names


def test_each_module_has_its_learning_rate() -> None:
    classifier = _classifier(PointDan(classifier_rate=3.0), build_net=lambda: pointdan(4, nodes=4))
    groups = classifier.configure_optimizers()[0][0].param_groups
    assert [group["lr"] for group in groups] == [1e-3, pytest.approx(3e-3)]
    assert {id(p) for p in groups[1]["params"]} == {
        id(p) for p in classifier.net.get_submodule("head").parameters()
    }
    ids = [id(p) for group in groups for p in group["params"]]
    assert sorted(ids) == sorted(id(p) for p in classifier.parameters())
