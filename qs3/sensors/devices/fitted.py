"""A camera as a few frames of a wall describe it: true depth plus fitted noise.

That is all that depth frames can tell; the speckle sensors, whose noise comes out of matched
images, need more. `qs3 fit` writes presets of this sensor.
"""

from dataclasses import replace
from typing import Annotated, ClassVar

import cv2
import numpy as np
from annotated_types import Interval

from qs3.geometry.cameras import Intrinsics
from qs3.sensors.base import DepthFrame, DepthSensor, Shot
from qs3.sensors.optics.visibility import Reason, first_reason
from qs3.utils.settings import Count, NotNegative, Positive, Share, settings


@settings
class FittedDepth(DepthSensor):
    """An empirical depth camera.

    depth = quantise(Z + bias(Z) + sigma(Z) n), where n is normal noise of variance 1 that is
    smooth over `correlation_px`, and sigma(Z) = noise_floor_m + noise_factor * Z ** noise_power.

    Attributes:
        cx_px, cy_px: principal point; null is the middle.
        step_px: every step-th pixel of every step-th row gives a depth, the middle of each step.
        min_depth_m, max_depth_m: depths outside are dropped.
        noise_floor_m, noise_factor, noise_power: of sigma(Z), Z in metres; power 2 for cameras
            that triangulate, 1 for time of flight.
        correlation_px: standard deviation of the Gaussian that smooths the noise, in the camera's
            pixels, whatever `step_px`; 0 is white.
        inverse_step_per_m: step of 1 / Z in 1/m (Kinect v1: 1 / (8 f b)); 0 is none.
        depth_step_m: step of Z, applied after that; 0 is none.
        bias_m: coefficients of bias(Z), the constant first.
        fill_rate: share of valid pixels.
        baseline_m: projector minus camera along the camera's x; what it does not reach is not
            measured. null: no shadows.
    """

    sees_light: ClassVar[bool] = False
    cx_px: float | None = None
    cy_px: float | None = None
    step_px: Count = 1
    min_depth_m: Positive = 0.3
    max_depth_m: Positive = 8.0
    noise_floor_m: NotNegative = 0.0
    noise_factor: NotNegative = 0.0015
    noise_power: float = 2.0
    correlation_px: Annotated[float, Interval(ge=0, le=50)] = 0.0
    inverse_step_per_m: NotNegative = 0.0
    depth_step_m: NotNegative = 0.0
    bias_m: tuple[float, ...] = (0.0,)
    fill_rate: Share = 1.0
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        assert self.min_depth_m < self.max_depth_m, "min_depth_m must be below max_depth_m"

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's."""
        middle = super().intrinsics
        return replace(
            middle,
            cx_px=middle.cx_px if self.cx_px is None else self.cx_px,
            cy_px=middle.cy_px if self.cy_px is None else self.cy_px,
        )

    def noise_law_m(self, depth_m: np.ndarray | float) -> np.ndarray | float:
        """Standard deviation of the noise at a distance, before the quantiser."""
        return self.noise_floor_m + self.noise_factor * depth_m**self.noise_power

    def measure(
        self, clean_m: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Measured depth [h, w] float32 with NaN, and uint8 `Reason`, of true depths with inf."""
        noise = _smooth(clean_m.shape, self.correlation_px / self.step_px, rng)
        hit = np.isfinite(clean_m)
        true = np.where(hit, clean_m, 1.0).astype(np.float64)
        bias = np.polynomial.polynomial.polyval(true, self.bias_m)
        found = true + bias + self.noise_law_m(true) * noise
        found = np.maximum(found, 1e-3)
        if self.inverse_step_per_m:
            steps = np.maximum(np.rint(1 / (found * self.inverse_step_per_m)), 1)
            found = 1 / (steps * self.inverse_step_per_m)
        if self.depth_step_m:
            found = np.rint(found / self.depth_step_m) * self.depth_step_m
        lost = rng.random(clean_m.shape) >= self.fill_rate
        inside = (found > self.min_depth_m) & (found < self.max_depth_m)
        reason = first_reason(
            {Reason.EMPTY: ~hit, Reason.UNMATCHED: lost, Reason.RANGE: ~inside}, Reason.OK
        )
        depth = np.where(reason == Reason.OK, found, np.nan).astype(np.float32)
        return depth, reason

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`. Shadows are always explained."""
        image, at = shot.image(), shot.samples(self.step_px)
        clean = at.of(image.depth_m)
        depth, reason = self.measure(clean, shot.rng)
        pictures = {"clean": image.depth_m}
        if self.baseline_m is not None:
            pictures["lit"] = shot.reached_from(shot.pose_at(self.baseline_m))
            dark = ~at.of(pictures["lit"]) & np.isfinite(clean)
            depth[dark], reason[dark] = np.nan, Reason.SHADOW
        return shot.frame(depth, reason, image, pictures, at)


def _smooth(shape: tuple[int, ...], size_px: float, rng: np.random.Generator) -> np.ndarray:
    """[h, w] float32 normal noise of variance 1, correlated over size_px."""
    if size_px <= 0 or 0 in shape:
        return rng.standard_normal(shape, dtype=np.float32)
    reach = max(1, round(4 * size_px))  # drawn beyond the border: mirrored noise would be stronger
    kernel = cv2.getGaussianKernel(2 * reach + 1, max(size_px, 1e-6), cv2.CV_32F)[:, 0]
    white = rng.standard_normal([side + 2 * reach for side in shape], dtype=np.float32)
    smooth = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)[reach:-reach, reach:-reach]
    return smooth / np.float32((kernel**2).sum())
