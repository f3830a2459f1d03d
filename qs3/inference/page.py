"""The page of `qs3 predict`: what was right, what was wrong, and what was wrong with the clouds.

One HTML file with its pictures inside. With labels the errors come first, the most confident
before the others; without, what is in doubt.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.evaluation.ood import MEASURES, OF_HEIGHTS, OF_METRES
from qs3.inference.inputs import Sample
from qs3.inference.predict import DISPUTED, STRANGE, disputed, kinds, right, scores
from qs3.utils.page import render
from qs3.utils.pictures import cloud_image, png, unit, value_image

MOST_SHOWN = 300
"""Objects with pictures; the others are in the table alone."""

_FEW, _COLLAPSED = 20, 0.8
"""With so many predictions and such a share of one class the page has a caution."""

_SIDE_PX, _POINTS, _OUTLINE = 168, 1024, (181, 64, 58)


def first_of(
    samples: Sequence[Sample], classes: Sequence[str], most: int = MOST_SHOWN
) -> list[Sample]:
    """The samples that the page shows with pictures, in its order; the others lose their clouds."""
    shown = sorted(samples, key=lambda one: rank(one, classes), reverse=True)
    for one in shown[most:]:
        one.cloud = one.picture = None
    return shown[:most]


def rank(one: Sample, classes: Sequence[str]) -> tuple[float, ...]:
    """The larger, the earlier: confident errors, then right ones in doubt; then what has no label.

    Without a label what something is wrong with comes first, then what is least sure.
    """
    correct = right(one, classes)
    if correct is None:
        return (0.0, float(bool(kinds(one))), -one.confidence)
    return (2.0, 0.0, one.confidence) if not correct else (1.0, 0.0, -one.confidence)


def page(
    title: str,
    samples: Sequence[Sample],
    shown: Sequence[Sample],
    classes: Sequence[str],
    floor_m: float | None = None,
    **about: Any,
) -> str:
    """The page as HTML.

    Args:
        title: what was predicted with what.
        samples: all of them.
        shown: those with pictures, in their order.
        classes: names in the order of the probabilities.
        floor_m: z of the floor, if the net knows heights: cards say how high an object begins.
        about: for the template: `trained_on`, what the net's data are made of; `worth`, its
            accuracy on real objects; `notes`, what was assumed.
    """
    found = scores(samples, classes)
    predicted = [one for one in samples if one.cls]
    unlabelled = "Without a label" + " that is a class of the net" * bool(found and found.unknown)
    groups = []
    for heading, note, wanted in (
        ("Wrong", "the most confident first", False),
        ("Right", "the least confident first", True),
        (unlabelled if found else "Predicted", "what is in doubt first", None),
    ):
        cards = [_card(one, classes, floor_m) for one in shown if right(one, classes) is wanted]
        total = sum(right(one, classes) is wanted for one in predicted)
        groups += [(heading, total, note, cards)] * bool(cards)
    points = round(100 * (found.confidence - found.all.share)) if found else 0
    surety = f"{abs(points)} points too {'sure' if points > 0 else 'unsure'}"
    return render(
        "predictions.html",
        title=title,
        found=found,
        predicted=len(predicted),
        labelled=any(one.label for one in predicted),
        surety=surety if abs(points) >= 5 else "about as sure as it is right",
        collapsed=_collapsed(predicted),
        groups=groups,
        failed=[(one.name, one.reason) for one in samples if not one.cls],
        most=MOST_SHOWN,
        confusion=confusion_rows(found.confusion, classes) if found else [],
        **{"trained_on": "", "worth": "", "notes": (), **about},
    )


def confusion_rows(matrix: Int[np.ndarray, "c c"], classes: Sequence[str]) -> list[dict[str, Any]]:
    """A confusion matrix for the templates: the classes that occur; darker is more of the row."""
    there = [k for k in range(len(classes)) if matrix[k].sum() or matrix[:, k].sum()]
    rows = []
    for i in there:
        total, cells = int(matrix[i].sum()), []
        for j in there:
            colour = "58,143,92" if i == j else "181,64,58"
            share = 0.75 * matrix[i, j] / max(total, 1)
            cells.append((int(matrix[i, j]), f"rgba({colour},{share:.2f})", i == j))
        rows.append({"name": classes[i], "cells": cells, "hits": int(matrix[i, i]), "total": total})
    return rows


def _collapsed(predicted: Sequence[Sample]) -> str:
    """A warning if nearly all are called the same."""
    ((best, times),) = Counter(one.cls for one in predicted).most_common(1) or [("", 0)]
    if len(predicted) < _FEW or times < _COLLAPSED * len(predicted):
        return ""
    return (
        f"{times} of {len(predicted)} are called {best}: the net hardly distinguishes "
        "these clouds. Is up right, and were its training clouds like these?"
    )


def _card(one: Sample, classes: Sequence[str], floor_m: float | None) -> dict[str, Any]:
    """One object: pictures, what it was called and is, and what was wrong with its cloud."""
    assert one.probabilities is not None
    second = int(np.argsort(-one.probabilities, kind="stable")[1])
    correct, cloud = right(one, classes), one.upright
    pictures = [("cloud", png(cloud_image(cloud[:: max(1, len(cloud) // _POINTS)], _SIDE_PX)))]
    if one.picture:
        pictures.append(("depth image", depth_png(*one.picture)))
    truth = f" is {one.label}" if one.label and not correct else ""
    truth += " (no class of the net)" * bool(one.label and one.label not in classes)
    meanings = {**MEASURES, **OF_METRES, **OF_HEIGHTS}
    tags = [(caution.words, "") for caution in one.cautions]
    for words in filter(None, one.reason.split("; ")):
        tags.append((f"{STRANGE}: {words}", meanings.get(words.split(" ")[0], "")))
    if disputed(one):
        tags.append((f"{DISPUTED}: {one.second}", ""))
    return {
        "style": {True: "right", False: "wrong", None: ""}[correct],
        "pictures": pictures,
        "called": one.cls,
        "sure": one.confidence,
        "truth": truth,
        "second": f"{classes[second]} {one.probabilities[second]:.0%}",
        "tags": tags,
        "file": f"{one.name}, {one.points} points" + (f", {one.tier}" if one.tier else ""),
        "size": _size(cloud, floor_m) if one.tier else "",
    }


def _size(cloud: Float[np.ndarray, "n 3"], floor_m: float | None) -> str:
    """How large it is (in its card a chair's back and a monitor look alike), and how high."""
    angles = np.linspace(0, np.pi, 18, endpoint=False)
    across = cloud[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])  # [n, 18]
    size = f"{np.ptp(across, axis=0).max():.2f} m wide, {np.ptp(cloud[:, 2]):.2f} m high"
    if floor_m is None:
        return size
    return f"{size}, from {cloud[:, 2].min() - floor_m:.2f} m above the floor"


def depth_png(depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> bytes:
    """The depth image around an object, near is light, with the outline of its pixels.

    Args:
        depth_m: 0 where nothing was measured, which is dark.
        mask: the object's pixels; at least one.
    """
    measured = depth_m > 0
    near = np.full(depth_m.shape, np.nan)
    if measured.any():
        low, high = np.quantile(depth_m[measured], [0.02, 0.98])
        near[measured] = 1 - unit(np.clip(depth_m[measured], low, high))
    picture = value_image(near, -0.18, 1, "gray")
    scale = _SIDE_PX / max(depth_m.shape)
    size = (max(int(depth_m.shape[1] * scale), 1), max(int(depth_m.shape[0] * scale), 1))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
    large = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, _OUTLINE, 2)
    return png(picture)
