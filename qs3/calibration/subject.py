"""A sensor on the bench, what the bench must know about it, and the targets before it.

The camera stands in the origin and looks along the world's x (qs3.geometry.cameras.look_at), so
that boxes of the world are boxes of the camera, and only the pixels wanted are rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.geometry.cameras import Intrinsics, Window, look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthSensor
from qs3.sensors.matching import STEREOBM_BIAS_PX, StereoBlockMatcher
from qs3.sensors.renderers.base import Body

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))
ALBEDO = 0.8
"""Albedo of all targets: a light wall."""

_DEPTHS_M = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
_QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def load(name: str, overrides: Sequence[str] = ()) -> Subject:
    """A sensor by the name of its file in conf/sensor ("kinect_v1"), and words of Hydra."""
    cfg = composed(None, f"+sensor={name}", *overrides, place=f"sensor={name}: ")
    return Subject(name, build(cfg.sensor))


@dataclass(frozen=True)
class Subject:
    """One sensor under test, by the name of its config."""

    name: str
    sensor: DepthSensor

    def _get(self, key: str, default: Any = None) -> Any:
        return getattr(self.sensor, key, default)

    @property
    def step_px(self) -> int:
        """Spacing of depth samples in pixels of the camera."""
        return int(self._get("step_px", 1))

    @property
    def baseline_m(self) -> float | None:
        """None for a sensor that does not triangulate."""
        value = self._get("baseline_m")
        return None if value is None else float(value)

    @property
    def focal_baseline(self) -> float | None:
        """Product f B in px m; None for a sensor that does not triangulate."""
        return None if self.baseline_m is None else self.sensor.focal_px * self.baseline_m

    @property
    def matcher(self) -> Any:
        """Its matcher; None where nothing is matched."""
        return self._get("matcher")

    @property
    def window_px(self) -> int | None:
        """Side of what one match looks at; None where nothing is matched."""
        window = getattr(self.matcher, "window_px", getattr(self.matcher, "block_size", None))
        # Costs of census windows are averaged over a block.
        return None if window is None else window + getattr(self.matcher, "block_px", 1) - 1

    @property
    def steps_per_px(self) -> int:
        """Even steps of the disparity a pixel; 0 where there are none (or nothing is known)."""
        return int(self._get("steps_per_px", 0))

    @property
    def whole_px(self) -> float:
        """Disparity f B / Z that is a whole pixel: not 0 against a stored image."""
        reference, fb = self._get("reference_m"), self.focal_baseline
        return fb / reference if reference and fb else 0.0

    @property
    def level_offset_px(self) -> float:
        """Disparity (f B / Z) of one of the levels of the quantiser."""
        if isinstance(self.matcher, StereoBlockMatcher) and self.matcher.remove_bias:
            return float(self._get("quantiser").apply(np.float32(-STEREOBM_BIAS_PX)))
        return self.whole_px

    def source_m(self, cameras: int) -> float | None:
        """Where the light comes from, along x from the camera; None if it has no place.

        Of two cameras the projector is in the middle, if the sensor does not say otherwise; one
        camera has it at the other end of the baseline.
        """
        if self.baseline_m is None:
            lamp = self._get("lamp_offset_m")
            return None if lamp is None else float(lamp)
        share = self._get("projector_share", 0.5 if cameras == 2 else 1.0)
        return self.baseline_m * float(share)

    @property
    def margin_px(self) -> int:
        """Pixels to render around what is measured, so that its edge does not matter."""
        return 2 * int(getattr(self.matcher, "reach_px", 2)) + 4

    def depths_m(self) -> list[float]:
        """Depths within its range, with room for the spread of a condition."""
        low = self._get("min_depth_m", 0.2)
        high = self._get("max_depth_m", self._get("max_distance_m", 6.0))
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


def _box_of(points_m: np.ndarray) -> np.ndarray:
    """[2, 3] box of the world around points [N, 3] of the camera's frame."""
    part = _to_world(points_m)
    return np.stack([part.min(axis=0) - 1e-4, part.max(axis=0) + 1e-4])


@dataclass(frozen=True)
class TiltedPlane:
    """A plane through a point of a pixel's ray, turned away from that ray.

    Attributes:
        depth_m: along the optical axis, at the centre of the region.
        tilt_deg: angle of incidence there; its sign is the side to which the plane recedes.
        along: the plane recedes along the rows of the image (along the baseline); else along
            the columns.
        centre_px: (u, v) of the region's centre, relative to the principal point.
    """

    depth_m: float
    tilt_deg: float = 0.0
    along: bool = True
    centre_px: tuple[float, float] = (0.0, 0.0)

    def inverse(self, focal_px: float) -> np.ndarray:
        """[3] (a, b, c) of 1 / Z = a x + b y + c, with x, y the tangents of a ray."""
        ray = np.array([self.centre_px[0] / focal_px, self.centre_px[1] / focal_px, 1.0])
        unit = ray / np.linalg.norm(ray)
        slope = np.array([1.0, 0, 0]) if self.along else np.array([0, 1.0, 0])
        slope -= (slope @ unit) * unit
        slope /= np.linalg.norm(slope)
        angle = np.deg2rad(self.tilt_deg)
        normal = np.cos(angle) * unit - np.sin(angle) * slope
        return normal / (normal @ ray * self.depth_m)

    def depth_at(self, u: np.ndarray, v: np.ndarray, focal_px: float) -> np.ndarray:
        """Depth at pixels relative to the principal point; not positive beyond the horizon."""
        a, b, c = self.inverse(focal_px)
        return 1 / (a * u / focal_px + b * v / focal_px + c)

    def region(self, k: Intrinsics, half_px: int, step_px: int = 1) -> Window:
        """The pixels to measure on: fewer where the depth would change much across them."""
        steep = abs(np.tan(np.deg2rad(self.tilt_deg)))
        flat = half_px if steep == 0 else min(half_px, int(0.12 * k.focal_px / steep))
        flat = max(flat, 2 * step_px + 1)
        wide, high = (flat, half_px) if self.along else (half_px, flat)
        u = round(k.cx_px + self.centre_px[0])
        v = round(k.cy_px + self.centre_px[1])
        return Window(u - wide, v - high, 2 * wide + 1, 2 * high + 1)

    def scene(
        self, k: Intrinsics, region: Window, margin_px: int
    ) -> tuple[tuple[Body, ...], np.ndarray]:
        """The plane, three margins wider than `region`, and the [2, 3] box of one margin."""
        body = Body(Mesh(_to_world(self._corners(k, region, 3 * margin_px)), _QUAD), ALBEDO)
        return (body,), _box_of(self._corners(k, region, margin_px))

    def _corners(self, k: Intrinsics, region: Window, margin_px: int) -> np.ndarray:
        """[4, 3] where the rays through the corners of a grown region meet the plane."""
        low_u, low_v = region.left - margin_px - k.cx_px, region.top - margin_px - k.cy_px
        high_u = low_u + region.width - 1 + 2 * margin_px
        high_v = low_v + region.height - 1 + 2 * margin_px
        # Not so far out that the plane comes near its horizon or the camera.
        a, b, _ = self.inverse(k.focal_px) * self.depth_m
        slope, centre = (a, self.centre_px[0]) if self.along else (b, self.centre_px[1])
        if slope:
            reach = 0.7 * k.focal_px / abs(slope)
            if self.along:
                low_u, high_u = max(low_u, centre - reach), min(high_u, centre + reach)
            else:
                low_v, high_v = max(low_v, centre - reach), min(high_v, centre + reach)
        u = np.array([low_u, high_u, high_u, low_u])
        v = np.array([low_v, low_v, high_v, high_v])
        z = self.depth_at(u, v, k.focal_px)
        return np.stack([u / k.focal_px * z, v / k.focal_px * z, z], axis=1)


@dataclass(frozen=True)
class SquareBeforeWall:
    """A square that faces the camera, before a wall that does.

    Attributes:
        near_m, far_m: depths of the square and of the wall.
        half_px: half the square's side in the image.
        shift_px: (u, v) of the square's centre relative to the principal point. A fraction of a
            pixel lets edges fall between pixels.
    """

    near_m: float
    far_m: float
    half_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)

    def scene(self, focal_px: float, around_px: int) -> tuple[tuple[Body, ...], np.ndarray]:
        """Square and wall, and the [2, 3] box of what is within `around_px` of the square."""

        def facing(depth_m: float, half_px: float) -> np.ndarray:
            (u, v), px = self.shift_px, depth_m / focal_px
            x = np.array([u - half_px, u + half_px, u + half_px, u - half_px]) * px
            y = np.array([v - half_px, v - half_px, v + half_px, v + half_px]) * px
            return np.stack([x, y, np.full(4, depth_m)], axis=1)

        front = facing(self.near_m, self.half_px)
        back = facing(self.far_m, self.half_px + 3 * around_px)
        bodies = tuple(Body(Mesh(_to_world(each), _QUAD), ALBEDO) for each in (front, back))
        return bodies, _box_of(facing(self.far_m, self.half_px + around_px))
