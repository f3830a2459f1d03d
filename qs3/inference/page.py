"""The page of `qs3 predict`: what was right, what was wrong, and what was wrong with the clouds.

One HTML file with its pictures inside. With labels the errors come first, the most confident
before the others; without, what is in doubt.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from qs3.evaluation.ood import MEASURES, OF_HEIGHTS, OF_METRES
from qs3.inference.inputs import Sample
from qs3.inference.scores import DISPUTED, STRANGE, Scores, disputed, kinds, right, scores
from qs3.inference.table import Row
from qs3.utils.page import confusion_rows, render
from qs3.utils.pictures import cloud_image, png, unit, value_image

MOST_SHOWN = 300
"""Objects with pictures; the others are in the table alone."""

_FEW, _COLLAPSED = 20, 0.8
"""With so many predictions and such a share of one class the page has a caution."""

_SIDE_PX, _POINTS, _OUTLINE = 168, 1024, (181, 64, 58)
_MARGIN = 0.35  # of an object's larger side, shown around it

Picture = tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]


class Gallery:
    """The rows that the page shows with pictures: those that come first, up to a number of them."""

    def __init__(self, classes: Sequence[str], most: int = MOST_SHOWN) -> None:
        self._classes, self._most = classes, most
        self._kept: list[tuple[tuple[float, ...], int, Row, Sample]] = []
        self._count = 0

    def add(self, row: Row, sample: Sample) -> None:
        """Offer a row with what it was made of."""
        self._count += 1
        first = (rank(row, self._classes), -self._count)
        full = len(self._kept) >= self._most
        if full and first <= self._kept[0][:2]:
            return
        if sample.picture:  # whole frames would be gigabytes
            sample = sample._replace(picture=around(*sample.picture))
        (heapq.heapreplace if full else heapq.heappush)(self._kept, (*first, row, sample))

    def shown(self) -> list[tuple[Row, Sample]]:
        """Those kept, in the order of the page."""
        return [(row, sample) for _, _, row, sample in sorted(self._kept, reverse=True)]


def rank(row: Row, classes: Sequence[str]) -> tuple[float, ...]:
    """The larger, the earlier: confident errors, then right ones in doubt; then what has no label.

    Without a label what something is wrong with comes first, then what is least sure.
    """
    assert row.probabilities is not None
    sure, correct = float(np.max(row.probabilities)), right(row, classes)
    if correct is None:
        return (0.0, float(bool(kinds(row, classes))), -sure)
    return (2.0, 0.0, sure) if not correct else (1.0, 0.0, -sure)


def page(
    title: str,
    rows: Sequence[Row],
    gallery: Gallery,
    classes: Sequence[str],
    trained_on: str = "",
    worth: str = "",
    notes: Sequence[str] = (),
    verdict: str = "",
    floor_m: float | None = None,
) -> str:
    """The page as HTML.

    Args:
        title: what was predicted with what.
        rows: all of them.
        gallery: those with pictures.
        classes: names in the order of the probabilities.
        trained_on: what the net's data are made of; "" if it is not known.
        worth: its accuracy on real objects; likewise.
        notes: what was assumed: where the floor is, how common classes are.
        verdict: how many are expected to be right, without a look at labels; likewise.
        floor_m: z of the floor, if the net knows heights: cards say how high an object begins.
    """
    found = scores(rows, classes)
    predicted = [row for row in rows if row.probabilities is not None]
    unlabelled = "Without a label" + " that is a class of the net" * bool(found and found.unknown)
    groups = []
    for heading, note, wanted in (
        ("Wrong", "the most confident first", False),
        ("Right", "the least confident first", True),
        (unlabelled if found else "Predicted", "what is in doubt first", None),
    ):
        some = [one for one in gallery.shown() if right(one[0], classes) is wanted]
        total = sum(right(row, classes) is wanted for row in predicted)
        if some:
            cards = [_card(row, sample, classes, floor_m) for row, sample in some]
            groups.append((heading, total, note, cards))
    return render(
        "predictions.html",
        title=title,
        found=found,
        predicted=len(predicted),
        labelled=any(row.label for row in predicted),
        surety=_surety(found) if found else "",
        collapsed=_collapsed(predicted, classes),
        trained_on=trained_on,
        worth=worth,
        notes=notes,
        verdict=verdict,
        groups=groups,
        failed=[(row.file, row.reason) for row in rows if row.probabilities is None],
        most=MOST_SHOWN,
        confusion=confusion_rows(found.confusion, classes) if found else [],
    )


def _surety(found: Scores) -> str:
    points = round(100 * (found.confidence - found.all.share))
    if abs(points) < 5:
        return "about as sure as it is right"
    return f"{abs(points)} points too {'sure' if points > 0 else 'unsure'}"


def _collapsed(predicted: Sequence[Row], classes: Sequence[str]) -> str:
    """A warning if nearly all are called the same."""
    names = Counter(int(np.argmax(row.probabilities)) for row in predicted)  # type: ignore[arg-type]
    ((best, times),) = names.most_common(1) or [(0, 0)]
    if len(predicted) < _FEW or times < _COLLAPSED * len(predicted):
        return ""
    return (
        f"{times} of {len(predicted)} are called {classes[best]}: the net hardly distinguishes "
        "these clouds. Is up right, and were its training clouds like these?"
    )


def _card(row: Row, sample: Sample, classes: Sequence[str], floor_m: float | None) -> Any:
    """One object: pictures, what it was called and is, and what was wrong with its cloud."""
    assert row.probabilities is not None
    best, second = np.argsort(-row.probabilities, kind="stable")[:2]
    correct = right(row, classes)
    cloud = _z_up(sample)
    pictures = [("cloud", png(cloud_image(cloud[:: max(1, len(cloud) // _POINTS)], _SIDE_PX)))]
    if sample.picture:
        pictures.append(("depth image", depth_png(*sample.picture)))
    truth = f" is {row.label}" if row.label and not correct else ""
    truth += " (no class of the net)" * bool(row.label and row.label not in classes)
    meanings = {**MEASURES, **OF_METRES, **OF_HEIGHTS}
    tags = [(caution.words, "") for caution in row.cautions]
    for words in filter(None, row.reason.split("; ")):
        tags.append((f"{STRANGE}: {words}", meanings.get(words.split(" ")[0], "")))
    if disputed(row, classes):
        tags.append((f"{DISPUTED}: {row.second}", ""))
    return {
        "style": {True: "right", False: "wrong", None: ""}[correct],
        "pictures": pictures,
        "called": classes[best],
        "sure": float(row.probabilities[best]),
        "truth": truth,
        "second": f"{classes[second]} {row.probabilities[second]:.0%}",
        "tags": tags,
        "file": f"{row.file}, {row.points or 0} points" + (f", {row.tier}" if row.tier else ""),
        "size": _size(cloud, floor_m) if sample.tier or sample.picture else "",
    }


def _size(cloud: Float[np.ndarray, "n 3"], floor_m: float | None) -> str:
    """How large it is: a chair's back and a monitor look alike when both fill their card.

    And how high it begins where the floor is known: nets that know heights depend on it, too.
    """
    angles = np.linspace(0, np.pi, 18, endpoint=False)
    across = cloud[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])  # [n, 18]
    size = f"{np.ptp(across, axis=0).max():.2f} m wide, {np.ptp(cloud[:, 2]):.2f} m high"
    if floor_m is None:
        return size
    return f"{size}, from {cloud[:, 2].min() - floor_m:.2f} m above the floor"


def _z_up(sample: Sample) -> Float[np.ndarray, "n 3"]:
    """The cloud for pictures and sizes, whatever frame the net sees it in."""
    from qs3.datasets.importing import turned

    cloud = np.asarray(sample.cloud, dtype=np.float64)[:, :3]
    if sample.world_from_camera is not None:
        return cloud @ np.asarray(sample.world_from_camera).T
    return turned(cloud, sample.axis)


def around(depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Picture:
    """Of both the part that `depth_png` shows, copied: a frame need not be kept for one object."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    half = int(side * (0.5 + _MARGIN)) + 4
    v, u = (int(rows[0] + rows[-1]) // 2, int(columns[0] + columns[-1]) // 2)
    at = slice(max(v - half, 0), v + half), slice(max(u - half, 0), u + half)
    return depth_m[at].copy(), mask[at].copy()


def depth_png(depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> bytes:
    """The part of a depth image around an object, near is light, with the outline of its pixels.

    Args:
        depth_m: 0 where nothing was measured, which is dark.
        mask: the object's pixels; at least one.
    """
    depth, own = around(depth_m, mask)
    measured = depth > 0
    near = np.full(depth.shape, np.nan)
    if measured.any():
        low, high = np.quantile(depth[measured], [0.02, 0.98])
        near[measured] = 1 - unit(np.clip(depth[measured], low, high))
    picture = value_image(near, -0.18, 1, "gray")
    scale = _SIDE_PX / max(depth.shape)
    size = (max(int(depth.shape[1] * scale), 1), max(int(depth.shape[0] * scale), 1))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
    large = cv2.resize(own.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, _OUTLINE, 2)
    return png(picture)
