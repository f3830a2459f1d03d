"""How much of a camera's own picture pairs a preset's matcher fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from qs3.calibration.fit.infrared import Pictures
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching.texture import for_picture
from qs3.sensors.optics.infrared import GreyNoise
from qs3.sensors.pixel_status import Reason

_MOST_COSTS = 400_000_000  # of a matcher at once: 1920 x 1080 pixels with 192 disparities


@dataclass(frozen=True)
class PairFill:
    """What a preset's matcher and filters leave of one pair.

    Attributes:
        name: of the scene.
        fill: share of the pixels that have a disparity, without the columns at the left that the
            right camera may not see (as many as disparities are searched).
        lost: the rest of them by `Reason`, in the order of their shares.
        own: share of the same pixels that have a depth in the camera's own image; None: there
            is no such image.
    """

    name: str
    fill: float
    lost: dict[Reason, float]
    own: float | None


def pair_fills(
    scenes: Sequence[Pictures], sensor: SpeckleStereo, noise: GreyNoise
) -> list[PairFill]:
    """The fill of each scene that has a right picture; of several frames the first.

    Of pictures too large for the matcher's memory the middle rows are taken. `noise` is that of
    the pictures, for a matcher whose threshold goes by it.
    """
    matcher = for_picture(sensor.matcher, noise)
    return [_fill(scene, replace(sensor, matcher=matcher)) for scene in scenes if scene.right]


def words_of(found: PairFill, preset: str) -> str:
    """One line for a report."""
    lost = ", ".join(
        f"{reason.name.lower()} {share:.1%}" for reason, share in found.lost.items() if share > 5e-4
    )
    own = "" if found.own is None else f"; the camera's own depth: {found.own:.1%}"
    return f"{found.name}: {preset} fills {found.fill:.1%}{f' (lost: {lost})' * bool(lost)}{own}"


def _fill(scene: Pictures, sensor: SpeckleStereo) -> PairFill:
    rows = _rows(scene.left[0].shape, sensor.matcher.num_disparities)
    left, right = (_whole(images[0][rows]) for images in (scene.left, scene.right))
    match = sensor.matcher.match(left, right)
    disparity = match.disparity
    for post in sensor.filters:
        disparity = post.apply(disparity)
    reach = sensor.matcher.min_disparity + sensor.matcher.num_disparities
    first = min(max(reach, 0), left.shape[1] // 2)
    there = np.isfinite(disparity)[:, first:]
    dropped = np.isfinite(match.disparity)[:, first:] & ~there
    reason = np.where(dropped, np.uint8(Reason.FILTERED), match.reason[:, first:])[~there]
    counts = np.bincount(reason, minlength=len(Reason)) / there.size
    order = sorted(Reason, key=lambda each: -counts[each])
    own = None
    if scene.depth_m is not None:
        own = float(np.isfinite(scene.depth_m[rows, first:]).mean())
    lost = {each: float(counts[each]) for each in order if counts[each]}
    return PairFill(scene.name, float(there.mean()), lost, own)


def _rows(shape: tuple[int, ...], disparities: int) -> slice:
    """The middle rows, as many as the matcher's memory allows."""
    height, width = shape[:2]
    kept = max(1, min(height, _MOST_COSTS // (width * disparities)))
    first = (height - kept) // 2
    return slice(first, first + kept)


def _whole(image: np.ndarray) -> np.ndarray:
    """[h, w] uint8, as the matcher gets it."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
