"""From the frames that show an object to its cloud: viewpoints, fusion, sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from qs3.datasets.scannet.labels import Labelled
from qs3.geometry.sampling import farthest_point_sampling_np


@dataclass(frozen=True, eq=False)
class ObjectCloud:
    """What became of one object.

    Attributes:
        labelled: object id, label, class.
        frames: that were fused, ascending; empty if there is no cloud.
        candidates: frames with enough points.
        fused_points: before sampling.
        cloud: [points, 3] float32 in the scene's world, metres, z up; None if there is none.
        reason: why there is none.
    """

    labelled: Labelled
    frames: tuple[int, ...]
    candidates: int
    fused_points: int
    cloud: np.ndarray | None
    reason: str = ""


@dataclass(eq=False)
class Sightings:
    """What the first pass notes of one object: the frames that show enough of it.

    Attributes:
        frames, eyes_m, counts, sums_m: of each such frame its number, the camera's position [3],
            the number of the object's points, and their sum [3] in the world.
        most: most points in any frame, enough or not, and that frame; (0, -1) if never seen.
    """

    frames: list[int] = field(default_factory=list)
    eyes_m: list[np.ndarray] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    sums_m: list[np.ndarray] = field(default_factory=list)
    most: tuple[int, int] = (0, -1)

    def see(self, frame: int, points_m: np.ndarray, eye_m: np.ndarray, more_than: int) -> None:
        """Note a frame: [n, 3] points of the object in the world, [3] the camera's position."""
        count = len(points_m)
        if count > self.most[0]:
            self.most = (count, frame)
        if count > more_than:
            self.frames.append(frame)
            self.eyes_m.append(eye_m)
            self.counts.append(count)
            self.sums_m.append(points_m.sum(axis=0))

    def viewpoints(self, count: int) -> tuple[int, ...]:
        """Well-spread frames, ascending; see `spread`."""
        if not self.frames:
            return ()
        centre = np.sum(self.sums_m, axis=0) / sum(self.counts)
        chosen = spread(np.array(self.eyes_m) - centre, self.counts, count)
        return tuple(sorted(self.frames[i] for i in chosen))


def spread(towards_m: np.ndarray, points: Sequence[int], count: int) -> list[int]:
    """Up to `count` viewpoints, in order: farthest point sampling of their directions.

    The first is the frame with most points; each next one is that whose direction from the
    object is farthest from those of all taken. Of equals the earliest is taken.

    Args:
        towards_m: [n, 3] from the object's centre to the camera of each frame.
        points: of the object in each frame.
    """
    length = np.linalg.norm(towards_m, axis=1, keepdims=True)
    directions = towards_m / np.where(length > 0, length, 1.0)
    chosen = [int(np.argmax(points))]
    gap = np.full(len(directions), np.inf)
    while len(chosen) < min(count, len(directions)):
        gap = np.minimum(gap, np.linalg.norm(directions - directions[chosen[-1]], axis=1))
        gap[chosen] = -1.0  # also where all stand at one place
        chosen.append(int(np.argmax(gap)))
    return chosen


def sampled(fused_m: np.ndarray, points: int) -> np.ndarray:
    """[points, 3] float32 by farthest point sampling from the first point on.

    Of fewer than `points` the order starts over, as `farthest_point_sampling_np` says.
    """
    return fused_m[farthest_point_sampling_np(fused_m, points)].astype(np.float32)
