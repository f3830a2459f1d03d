"""What the page of predictions keeps of its objects, and what it says of labels."""

from __future__ import annotations

import numpy as np
import pytest

from qs3.inference.inputs import Sample, around
from qs3.inference.page import first_of, page

HIGH, WIDE = 240, 320
CLASSES = ("a", "b")


def predicted(name: str, sure: float = 0.75, **more) -> Sample:
    each = np.array([sure, 1 - sure])
    return Sample(name, np.eye(3), 0, probabilities=each, cls="a", **more)


@pytest.mark.parametrize(
    "box",
    [
        (100, 120, 130, 180), (0, 0, 20, 20), (HIGH - 9, 40, HIGH, 90), (30, WIDE - 1, 200, WIDE),
        (0, 0, HIGH, WIDE), (7, 11, 8, 12),
    ],
)  # fmt: skip
def test_the_part_around_an_object_holds_it_and_no_frame(box) -> None:
    top, left, bottom, right = box
    mask = np.zeros((HIGH, WIDE), dtype=bool)
    mask[top:bottom, left:right] = True
    depth, own = around(np.random.default_rng(0).uniform(0.5, 4.0, size=(HIGH, WIDE)), mask)
    assert own.sum() == mask.sum()
    assert depth.base is None
    assert depth.shape == own.shape
    assert max(depth.shape) <= 1.8 * max(bottom - top, right - left) + 10


def test_twenty_of_sixty_come_first_and_the_others_are_let_go() -> None:
    samples = [predicted(str(i), 0.5 + i / 200) for i in range(60)]
    shown = first_of(samples, CLASSES, 20)
    assert [one.name for one in shown] == [str(i) for i in range(20)]  # least sure first
    assert [one.cloud is None for one in samples] == [False] * 20 + [True] * 40
    errors = [predicted(str(i), 0.5 + i / 200, label="b") for i in range(60)]
    assert [one.name for one in first_of(errors, CLASSES, 2)] == ["59", "58"]  # most sure first


@pytest.mark.parametrize(
    ("label", "said"),
    [("", "No labels were given:"), ("mug", "No label given is a class of the net:")],
)
def test_the_page_says_why_nothing_was_judged(label: str, said: str) -> None:
    one = predicted("x.npy", label=label)
    text = page("x", [one], [one], CLASSES)
    assert said in text
    assert text.count("it is not known which are right") == 1


@pytest.mark.parametrize("third", ["", "mug"])
def test_what_has_a_label_of_another_class_is_not_called_unlabelled(third: str) -> None:
    samples = [predicted("x", label="a"), predicted("y"), predicted("z", label=third)]
    text = page("x", samples, first_of(samples, CLASSES), CLASSES)
    assert f"Without a label, not counted: {1 if third else 2}<" in text
    heading = "Without a label that is a class of the net" if third else "Without a label"
    assert f"<h2>{heading}: 2 <" in text
