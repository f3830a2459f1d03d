"""A sensor on the bench, and what the bench must know about it, read off its settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import ConfigError
from qs3.geometry.cameras import Intrinsics
from qs3.sensors.base import DepthSensor
from qs3.sensors.matching import STEREOBM_BIAS_PX, StereoBlockMatcher

DEPTHS_M = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)


@dataclass(frozen=True)
class Subject:
    """One sensor under test.

    Attributes:
        name: of its config.
        sensor: what is tested.
    """

    name: str
    sensor: DepthSensor

    def _get(self, key: str, default: Any = None) -> Any:
        return getattr(self.sensor, key, default)

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's whose depth image it is."""
        return self.sensor.intrinsics

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
        for depth in DEPTHS_M:
            spread = 0.02 * depth if fb is None else depth - fb / (fb / depth + 0.55)
            far = depth * 1.02 if fb is None else fb / max(fb / depth - 0.55, 1e-6)
            # Five standard deviations of a coarse sensor fit between the last plane and the end.
            room = 0 if fb is None else 0.4 * depth**2 / fb
            if depth - spread - room > low and far + room < high:
                out.append(depth)
        if len(out) < 2:
            raise ConfigError(
                f"sensor={self.name} measures {low} to {high} m, where fewer than two of the "
                f"bench's depths {DEPTHS_M} fit"
            )
        return out
