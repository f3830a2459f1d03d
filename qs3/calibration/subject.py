"""A sensor on the bench, what the bench must know about it, and where its targets stand.

The camera stands in the origin and looks along the world's x (qs3.geometry.cameras.look_at), so
that boxes of the world are boxes of the camera, and only the pixels wanted are rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.generation.sense import device
from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthSensor
from qs3.sensors.renderers.base import Body

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))
_DEPTHS_M = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)


def load(name: str, overrides: Sequence[str] = ()) -> Subject:
    """A sensor by the name of its file in conf/sensor ("kinect_v1"), and words of Hydra."""
    return Subject(name, device(name, *overrides))


@dataclass(frozen=True)
class Subject:
    """One sensor under test, by the name of its config."""

    name: str
    sensor: DepthSensor

    @property
    def step_px(self) -> int:
        """Spacing of depth samples in pixels of the camera."""
        return int(getattr(self.sensor, "step_px", 1))

    @property
    def baseline_m(self) -> float | None:
        """None for a sensor that does not triangulate."""
        value = getattr(self.sensor, "baseline_m", None)
        return None if value is None else float(value)

    @property
    def focal_baseline(self) -> float | None:
        """Product f B in px m; None for a sensor that does not triangulate."""
        return None if self.baseline_m is None else self.sensor.focal_px * self.baseline_m

    @property
    def matcher(self) -> Any:
        """Its matcher; None where nothing is matched."""
        return getattr(self.sensor, "matcher", None)

    @property
    def window_px(self) -> int | None:
        """Side of what one match looks at; None where nothing is matched."""
        window = getattr(self.matcher, "window_px", getattr(self.matcher, "block_size", None))
        # Costs of census windows are averaged over a block.
        return None if window is None else window + getattr(self.matcher, "block_px", 1) - 1

    @property
    def margin_px(self) -> int:
        """Pixels to render around what is measured, so that its edge does not matter."""
        return 2 * int(getattr(self.matcher, "reach_px", 2)) + 4

    def depths_m(self) -> list[float]:
        """Depths within its range, with room for the spread of a condition."""
        low = getattr(self.sensor, "min_depth_m", 0.2)
        farthest_m = getattr(self.sensor, "max_distance_m", 6.0)
        high = getattr(self.sensor, "max_depth_m", farthest_m)
        fb = None if self.focal_baseline is None else abs(self.focal_baseline)  # to either side
        out = []
        for depth in _DEPTHS_M:
            spread = 0.02 * depth if fb is None else depth - fb / (fb / depth + 0.55)
            far = depth * 1.02 if fb is None else fb / max(fb / depth - 0.55, 1e-6)
            # Five standard deviations of a coarse sensor fit between the last plane and the end.
            room = 0 if fb is None else 0.4 * depth**2 / fb
            if depth - spread - room > low and far + room < high:
                out.append(depth)
        return out


def _to_world(points_m: np.ndarray) -> np.ndarray:
    """[N, 3] of the camera's frame to the world's."""
    return points_m @ POSE[:3, :3].T


def quad(corners_m: np.ndarray) -> Body:
    """A target with corners [4, 3] in the camera's frame."""
    return Body(Mesh(_to_world(corners_m), np.array([[0, 1, 2], [0, 2, 3]])), albedo=0.8)


def box_of(points_m: np.ndarray) -> np.ndarray:
    """[2, 3] box of the world around points [N, 3] of the camera's frame."""
    part = _to_world(points_m)
    return np.stack([part.min(axis=0) - 1e-4, part.max(axis=0) + 1e-4])
