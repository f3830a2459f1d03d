"""What the page of predictions keeps of its objects while others are read."""

from __future__ import annotations

import numpy as np
import pytest

from qs3.inference.inputs import Sample
from qs3.inference.page import Gallery, around, depth_png, page

HIGH, WIDE = 240, 320


def frame(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 4.0, size=(HIGH, WIDE))


def box(top: int, left: int, bottom: int, right: int) -> np.ndarray:
    mask = np.zeros((HIGH, WIDE), dtype=bool)
    mask[top:bottom, left:right] = True
    return mask


@pytest.mark.parametrize(
    "mask",
    [
        box(100, 120, 130, 180),
        box(0, 0, 20, 20),
        box(HIGH - 9, 40, HIGH, 90),
        box(30, WIDE - 1, 200, WIDE),
        box(0, 0, HIGH, WIDE),
        box(7, 11, 8, 12),
    ],
)
def test_the_part_that_is_shown_is_shown_alike(mask: np.ndarray) -> None:
    depth = frame(0)
    part = around(depth, mask)
    assert part[1].sum() == mask.sum()
    assert depth_png(*part) == depth_png(depth, mask)


def test_no_object_keeps_its_frame() -> None:
    """Twenty of 60 come first, and of each the part around it is kept, once."""
    gallery = Gallery(("a", "b"), most=20)
    mask = box(100, 100, 120, 130)
    for i in range(60):
        sample = Sample(f"{i}", np.zeros((8, 3)), 0, picture=(frame(i), mask))
        gallery.add(sample.row("", np.array([0.5 + i / 200, 0.5 - i / 200])), sample)
    shown = gallery.shown()
    assert [row.file for row, _ in shown] == [str(i) for i in range(20)]  # least sure first
    for row, sample in shown:
        depth, own = sample.picture
        assert depth.base is None
        assert depth.nbytes < 100 * 100 * 8
        assert depth_png(depth, own) == depth_png(frame(int(row.file)), mask)


@pytest.mark.parametrize(
    ("label", "said"),
    [("", "No labels were given:"), ("mug", "No label given is a class of the net:")],
)
def test_the_page_says_why_nothing_was_judged(label: str, said: str) -> None:
    gallery = Gallery(("a", "b"))
    sample = Sample("x.npy", np.eye(3), 0, label=label)
    row = sample.row("", np.array([0.75, 0.25]))
    gallery.add(row, sample)
    text = page("x", [row], gallery, ("a", "b"))
    assert said in text
    assert text.count("it is not known which are right") == 1


@pytest.mark.parametrize("third", ["", "mug"])
def test_what_has_a_label_of_another_class_is_not_called_unlabelled(third: str) -> None:
    """Its heading counted it; the line above, which counts what has none, did not."""
    gallery, rows = Gallery(("a", "b")), []
    for name, label in (("x", "a"), ("y", ""), ("z", third)):
        sample = Sample(name, np.eye(3), 0, label=label)
        rows.append(sample.row("", np.array([0.75, 0.25])))
        gallery.add(rows[-1], sample)
    text = page("x", rows, gallery, ("a", "b"))
    assert f"Without a label, not counted: {1 if third else 2}<" in text
    heading = "Without a label that is a class of the net" if third else "Without a label"
    assert f"<h2>{heading}: 2 <" in text
