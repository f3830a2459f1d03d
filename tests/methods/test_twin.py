"""Twin: its terms by loops and known answers, what a weight of 0 costs, three shifts it learns."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from qs3.datamodules.twins import Wants
from qs3.errors import ConfigError
from qs3.methods.twin import Twin, distillation, jensen_shannon
from tests.methods.parted import blobs
from tests.methods.shapes import CLASSES, accuracy, tiny_net, train

OFF = dict.fromkeys(("twin_weight", "logit_weight", "feature_weight", "again_weight"), 0.0)
OFF |= {"view_weight": 0.0, "target_weight": 0.0}


def _batch(progress: float = 1.0) -> dict[str, Any]:
    points = torch.rand(5, 4, 24, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return {
        "source": {
            "points": points[0], "twin": points[1], "again": points[2], "y_source": torch.arange(4),
        },
        "target": {"points": points[3], "twin": points[4]},
        "progress": progress,
    }  # fmt: skip


def _made(**settings: Any) -> tuple[Any, Twin]:
    """A net whose teachers, but for a shared one, are other nets by now."""
    net, method = tiny_net(norm=False), Twin(**settings)
    method.prepare(net)
    if method.teacher is not None:
        method.follow(net)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in net.parameters():
            p += 0.2 * torch.randn(p.shape, generator=generator)
    return net, method


def _softmax(logits: Tensor, temperature: float = 1.0) -> list[float]:
    values = [math.exp(float(x) / temperature) for x in logits]
    return [x / sum(values) for x in values]


def _kl(q: list[float], p: list[float]) -> float:
    return sum(a * math.log(a / b) for a, b in zip(q, p, strict=True))


@pytest.mark.parametrize("teacher", ["mean", "shared", "own"])
def test_every_term_by_loops(teacher: str) -> None:
    weights = {"twin_weight": 2.0, "logit_weight": 3.0, "feature_weight": 5.0, "view_weight": 7.0}
    net, method = _made(
        **weights,
        again_weight=13.0,
        target_weight=11.0,
        temperature=1.5,
        target_temperature=0.4,
        teacher=teacher,
    )
    batch = _batch(progress=0.5)
    with torch.no_grad():
        terms = method.loss(net, batch, torch.Generator())
    source, target = batch["source"], batch["target"]
    net.requires_grad_(False)
    method.requires_grad_(False)
    means = net if teacher == "shared" else method.teacher
    said = method.expert if teacher == "own" else means
    learner = said if teacher == "own" else net
    assert teacher == "shared" or not torch.equal(said(source["twin"]), net(source["twin"]))
    found: dict[str, list[float]] = {name: [] for name in terms}
    for i in range(4):
        one = {key: value[i : i + 1] for key, value in source.items()}
        student, again = net(one["points"])[0], net(one["again"])[0]
        found["ce"].append(-math.log(_softmax(student)[i]))
        found["twin"].append(-2.0 * math.log(_softmax(learner(one["twin"])[0])[i]))
        q, p = _softmax(said(one["twin"])[0], 1.5), _softmax(student, 1.5)
        found["logits"].append(3.0 * 1.5**2 * _kl(q, p))
        u, v = said.features(one["twin"]).global_[0], net.features(one["points"]).global_[0]
        cosine = float(u @ v) / math.sqrt(float(u @ u) * float(v @ v))
        found["features"].append(5.0 * (1 - cosine))
        a, b = _softmax(student), _softmax(again)
        found["again"].append(-13.0 * math.log(b[i]))
        mean = [(x + y) / 2 for x, y in zip(a, b, strict=True)]
        found["views"].append(7.0 * (_kl(a, mean) + _kl(b, mean)) / 2)
        q = _softmax(means(target["twin"][i : i + 1])[0], 0.4)
        p = _softmax(net(target["points"][i : i + 1])[0])
        ramp = 11.0 * math.exp(-5 * 0.25)
        found["target"].append(-ramp * sum(x * math.log(y) for x, y in zip(q, p, strict=True)))
    assert set(terms) == {"ce", "twin", "logits", "features", "again", "views", "target"}
    for name, each in found.items():
        assert terms[name].item() == pytest.approx(sum(each) / 4, rel=1e-4), name


def test_known_answers() -> None:
    sure, other = torch.tensor([[40.0, 0.0]]), torch.tensor([[0.0, 40.0]])
    even = torch.zeros(1, 2)
    assert jensen_shannon(sure, other).item() == pytest.approx(math.log(2))
    assert jensen_shannon(sure, sure).item() == pytest.approx(0, abs=1e-7)
    assert distillation(sure, even, 1.0).item() == pytest.approx(math.log(2))
    assert distillation(other, other, 3.0).item() == pytest.approx(0, abs=1e-6)
    assert distillation(10 * sure, even, 10.0).item() == pytest.approx(100 * math.log(2))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 30), st.floats(0.3, 8))
def test_divergences_are_none_for_equals_bounded_and_symmetric(
    seed: int, size: float, temperature: float
) -> None:
    first, second = size * torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(seed))
    divergence = jensen_shannon(first, second)
    assert -1e-6 <= divergence <= math.log(2) + 1e-6
    torch.testing.assert_close(divergence, jensen_shannon(second, first), rtol=1e-4, atol=1e-6)
    assert distillation(first, second, temperature) >= -1e-4
    shifted = second + 3.0  # logits are known up to a constant
    torch.testing.assert_close(
        distillation(first, second, temperature), distillation(first, shifted, temperature),
        rtol=1e-3, atol=1e-4,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("on", "wants", "passes", "teacher"),
    [
        ({}, Wants(), 1, False),
        ({"twin_weight": 1.0}, Wants("whole"), 2, False),
        ({"logit_weight": 1.0}, Wants("whole"), 1, True),
        ({"feature_weight": 1.0, "sees": "clean"}, Wants("clean"), 1, True),
        ({"again_weight": 1.0}, Wants(again=True), 2, False),
        ({"view_weight": 1.0}, Wants(again=True), 2, False),
        ({"target_weight": 1.0}, Wants(target_twin=True), 2, True),
        ({"logit_weight": 1.0, "teacher": "shared"}, Wants("whole"), 2, False),
        ({"twin_weight": 1.0, "logit_weight": 1.0, "teacher": "own"}, Wants("whole"), 1, False),
    ],
)
def test_a_part_that_is_off_costs_nothing(
    on: dict[str, Any], wants: Wants, passes: int, teacher: bool
) -> None:
    """Neither clouds that are loaded, nor passes, nor a teacher."""
    net, method = _made(**{**OFF, **on})
    assert method.wants == wants
    assert method.uses_target == wants.target_twin
    assert (method.teacher is not None) == teacher
    assert bool([name for name in method.state_dict() if name.startswith("teacher")]) == teacher
    assert (method.expert is not None) == (on.get("teacher") == "own")
    batch, calls = _batch(), []
    for key, wanted in (("twin", wants.twin), ("again", wants.again)):
        if not wanted:
            del batch["source"][key]
    if not wants.target_twin:
        del batch["target"]
    net.backbone.register_forward_hook(lambda *_: calls.append(1))
    terms = method.loss(net, batch, torch.Generator())
    assert len(calls) == passes
    assert len(terms) == 1 + sum(key.endswith("_weight") for key in on)


@pytest.mark.parametrize("teacher", ["mean", "shared"])
def test_no_gradient_reaches_the_teacher_or_its_clouds(teacher: str) -> None:
    """A shared one learns by the other terms alone: what it says of a twin is a constant."""
    on = {"logit_weight": 1.0, "feature_weight": 1.0, "target_weight": 1.0}
    net, method = _made(**{**OFF, **on, "teacher": teacher})
    batch = _batch()
    seen = [batch["source"]["twin"], batch["target"]["twin"], batch["source"]["points"]]
    for clouds in seen:
        clouds.requires_grad_()
    torch.stack(list(method.loss(net, batch, torch.Generator()).values())).sum().backward()
    assert seen[0].grad is None
    assert seen[1].grad is None
    assert seen[2].grad is not None
    assert seen[2].grad.any()
    if method.teacher is not None:
        assert all(p.grad is None for p in method.teacher.parameters())
        assert not any(module.training for module in method.teacher.modules())


def test_a_teacher_of_its_own_learns_twins_and_the_student_does_not() -> None:
    """No other term moves it, and its own moves nothing else."""
    on = {"twin_weight": 2.0, "logit_weight": 1.0, "feature_weight": 1.0}
    net, method = _made(**{**OFF, **on, "teacher": "own"})
    assert method.teacher is None  # no means are asked
    assert {id(p) for p in method.parameters()} == {id(p) for p in method.expert.parameters()}
    batch = _batch()
    torch.stack(list(method.loss(net, batch, torch.Generator()).values())).sum().backward()
    found = [p.grad.clone() for p in method.expert.parameters()]
    method.expert.zero_grad()
    classes = method.expert(batch["source"]["twin"])
    (2 * F.cross_entropy(classes, batch["source"]["y_source"])).backward()
    for alone, beside in zip(method.expert.parameters(), found, strict=True):
        torch.testing.assert_close(alone.grad, beside)
    assert any(gradient.any() for gradient in found)
    net.zero_grad(set_to_none=True)
    method.loss(net, batch, torch.Generator())["twin"].backward()
    assert all(p.grad is None for p in net.parameters())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sees": "fused"}, "method.sees must be one of"),
        ({"teacher": "none"}, "method.teacher must be one of"),
        ({"temperature": 0.0}, "method.temperature must be > 0"),
        ({"target_temperature": -1.0}, "method.target_temperature must be > 0"),
        ({**OFF, "twin_weight": 1.0, "teacher": "own"}, "teacher=own learns by method.twin_weight"),
        ({**OFF, "logit_weight": 1.0, "teacher": "own"}, "or method.teacher=mean"),
        ({"momentum": 2.0}, r"method.momentum must be in \[0, 1\]"),
        *(({key: -1.0}, f"method.{key} must be >= 0") for key in OFF),
    ],
)
def test_wrong_settings_name_the_key(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Twin(**settings)


@pytest.mark.parametrize(
    ("key", "value", "weight"),
    [("temperature", 4.0, "logit_weight"), ("target_temperature", 1.0, "target_weight")],
)
def test_a_temperature_that_nothing_reads_is_refused(key: str, value: float, weight: str) -> None:
    """It would be a run of its own, equal to the bit to the one without it."""
    with pytest.raises(ConfigError, match=rf"method.{key}={value} would .* method.{weight} above"):
        Twin(**{key: value})
    assert getattr(Twin(**{key: value, weight: 1.0}), key) == value


@pytest.mark.parametrize(
    ("settings", "read"),
    [
        ({"sees": "clean"}, {"twin_weight": 1.0}),
        ({"sees": "scan"}, {"feature_weight": 1.0}),
        ({"teacher": "shared"}, {"target_weight": 1.0}),
        ({"teacher": "shared"}, {"logit_weight": 1.0}),
        ({"momentum": 0.9}, {"target_weight": 1.0}),
        ({"momentum": 0.9}, {"logit_weight": 1.0}),
    ],
)
def test_what_a_teacher_who_teaches_nothing_would_see_is_refused(
    settings: dict[str, Any], read: dict[str, float]
) -> None:
    (key,) = settings
    with pytest.raises(ConfigError, match=rf"method.{key}=\S+ would have no effect; set method\."):
        Twin(**settings)
    Twin(**settings, **read)


@pytest.mark.parametrize("teacher", ["shared", "own"])
def test_a_momentum_of_no_means_is_refused(teacher: str) -> None:
    on = {"twin_weight": 1.0, "logit_weight": 1.0, "teacher": teacher}
    with pytest.raises(ConfigError, match=r"method.momentum=0.9 would .* method.teacher=mean, or"):
        Twin(**on, momentum=0.9)
    if teacher == "own":  # of target clouds the means teach beside it
        Twin(**on, target_weight=1.0, momentum=0.9)


@pytest.mark.slow
def test_a_cut_target_cloud_is_taken_for_what_it_was_before_the_cut() -> None:
    """The source's left side says nothing of the class, the target's another corner than the right.

    Only whole clouds have the right side by which the source's classes are known; so the copy
    without the target's part cannot know the left side's.
    """
    result = torch.zeros(2, 2)
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        labels = torch.arange(256) % CLASSES
        other, of_target = (torch.randint(CLASSES, (256,), generator=generator) for _ in range(2))
        source = blobs(labels, other, generator)
        left = (of_target + 1) % CLASSES
        whole, cut = (blobs(right, left, generator) for right in (of_target, None))
        held_out = blobs(None, (labels + 1) % CLASSES, generator)
        for i, u in enumerate((2.0, 0.0)):
            net = tiny_net(seed, norm=False)
            method = Twin(**{**OFF, "target_weight": u}, momentum=0.9)
            beside = ({}, {"twin": whole})
            train(method, net, (source, labels), cut, steps=150, seed=seed, beside=beside)
            result[seed, i] = accuracy(net, held_out, labels)
    assert result[:, 0].min() > 0.8, result
    assert result[:, 1].max() < 0.5, result


def _parts(labels: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Wholes, by which a class is plain, and what is left of them: a weak sign among strays."""
    b = len(labels)
    whole = blobs(labels, torch.randint(CLASSES, (b,), generator=generator), generator)
    sign = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])[labels]
    part = torch.rand(b, 10, 3, generator=generator) * 2 - 1
    part[:, :, 1:] = part[:, :, 1:] + 0.35 * sign[:, None]
    return whole, part


@pytest.mark.slow
@pytest.mark.parametrize("teacher", ["mean", "own"])
def test_a_teacher_of_wholes_sees_through_wrong_labels(teacher: str) -> None:
    """Four labels in ten are wrong. Wholes tell which: the teacher is not misled, and says so.

    Its copy learns the same few parts by the labels alone, and by heart.
    """
    taught = {"twin_weight": 1.0, "logit_weight": 5.0, "teacher": teacher}
    result = torch.zeros(3, 2)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        labels, held_out = (torch.arange(n) % CLASSES for n in (64, 400))
        whole, part = _parts(labels, generator)
        _, unseen = _parts(held_out, generator)
        wrong = torch.rand(64, generator=generator) < 0.4
        given = torch.where(wrong, (labels + 1) % CLASSES, labels)
        for i, on in enumerate((taught, {"twin_weight": 1.0})):
            net = tiny_net(seed, norm=False)
            method = Twin(**{**OFF, **on}, momentum=0.9)
            beside = ({"twin": whole}, {})
            train(method, net, (part, given), part, steps=250, seed=seed, beside=beside)
            result[seed, i] = accuracy(net, unseen, held_out)
    assert (result[:, 0] - result[:, 1]).mean() > 0.05, result


@pytest.mark.parametrize("key", ["view_weight", "again_weight"])
def test_a_second_draw_teaches_what_the_first_hides(key: str) -> None:
    """The labelled draw shows an object's right side, the second draw its left, as test clouds do.

    A left corner is the right one of another class; so the copy without the term cannot know it.
    """
    result = torch.zeros(2, 2)
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        labels = torch.arange(256) % CLASSES
        left, held_out = (blobs(None, labels, generator) for _ in range(2))
        mirrored = blobs(None, (labels + 1) % CLASSES, generator)
        right = mirrored * torch.tensor([-1.0, 1.0, 1.0])
        for i, v in enumerate((1.0, 0.0)):
            net = tiny_net(seed, norm=False)
            method = Twin(**{**OFF, key: v})
            beside = ({"again": left}, {})
            train(method, net, (right, labels), right, steps=200, seed=seed, beside=beside)
            result[seed, i] = accuracy(net, held_out, labels)
    assert result[:, 0].min() > 0.8, result
    assert result[:, 1].max() < 0.25, result
