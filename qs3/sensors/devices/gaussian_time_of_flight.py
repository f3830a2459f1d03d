"""Time of flight in the manner of BlenSor: the true distance plus noise of one size.

Gschwandtner et al., "BlenSor: Blender Sensor Simulation Toolbox", 2011: a ray a pixel, a normal
error on the distance, and, if wanted, distances folded back into the range that one modulation
frequency can tell apart. For physics see qs3.sensors.devices.time_of_flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.config.checks import check_ranges
from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.base import DepthFrame, on_grid, window_of
from qs3.sensors.pixel_status import Reason
from qs3.sensors.renderers.base import Body, Renderer, Scene


@dataclass(frozen=True)
class GaussianTimeOfFlight:
    """Distance with a normal error.

    The defaults are BlenSor's for the SwissRanger SR4000: 176 x 144 px over 43.6 degrees, mean
    0 and sigma 4 mm, 20 m reach, no back-folding; the device's first model is unambiguous up to
    5 m.

    Attributes:
        width_px, height_px, focal_px: of the camera.
        step_px: every step-th pixel of every step-th row gives a depth, the middle of each step.
        noise_mean_m, noise_sigma_m: of the error of the distance along the ray.
        backfolding: distances are known only modulo `unambiguous_m`.
        unambiguous_m: c / (2 f) of the device.
        max_distance_m: surfaces further away give nothing.
    """

    width_px: int = 176
    height_px: int = 144
    focal_px: float = 220.0
    step_px: int = 1
    noise_mean_m: float = 0.0
    noise_sigma_m: float = 0.004
    backfolding: bool = False
    unambiguous_m: float = 5.0
    max_distance_m: float = 20.0

    def __post_init__(self) -> None:
        check_ranges(self, "sensor.", step_px=">= 1", noise_sigma_m=">= 0")
        check_ranges(self, "sensor.", unambiguous_m="> 0", max_distance_m="> 0")

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera."""
        return Intrinsics.centred(self.width_px, self.height_px, self.focal_px)

    def scan(
        self,
        bodies: tuple[Body, ...],
        box_m: np.ndarray,
        world_from_camera: np.ndarray,
        renderer: Renderer,
        rng: np.random.Generator,
        explain: bool = False,
    ) -> DepthFrame | None:
        """Take one frame; see qs3.sensors.base.DepthSensor. There is nothing to explain."""
        camera = Camera(self.intrinsics, world_from_camera)
        window = window_of(box_m, camera)
        if window is None:
            return None
        first_col, cols = on_grid(window.left, window.width, self.step_px)
        first_row, rows = on_grid(window.top, window.height, self.step_px)
        (image,) = renderer.render(
            Scene(bodies),
            [Camera(self.intrinsics, world_from_camera, window)],
            seed=int(rng.integers(2**31)),
            geometry=[True],
        )
        grid = (rows, cols)
        clean = np.ascontiguousarray(image.depth_m[grid])
        length = _ray_length(self.intrinsics, window)[grid]
        distance = clean.astype(np.float64) * length
        error = self.noise_mean_m + self.noise_sigma_m * rng.standard_normal(clean.shape)
        found = distance + error
        if self.backfolding:
            with np.errstate(invalid="ignore"):
                found = found % self.unambiguous_m
        hit = np.isfinite(clean)
        reached = hit & (distance <= self.max_distance_m)
        reason = np.select(
            [reached, hit], [np.uint8(Reason.OK), np.uint8(Reason.RANGE)], np.uint8(Reason.EMPTY)
        )
        return DepthFrame(
            camera=camera,
            left=first_col,
            top=first_row,
            step_px=self.step_px,
            depth_m=np.where(reached, found / length, np.nan).astype(np.float32),
            clean_m=clean,
            label=np.ascontiguousarray(image.label[grid]),
            cosine=np.ascontiguousarray(image.cosine[grid]),
            reason=reason.astype(np.uint8),
            images={"clean": image.depth_m},
        )


def _ray_length(k: Intrinsics, window: Window) -> np.ndarray:
    """[h, w] length of the ray through each pixel at depth 1."""
    x = (window.left + np.arange(window.width) - k.cx_px) / k.focal_px
    y = ((window.top + np.arange(window.height) - k.cy_px) / k.focal_px)[:, None]
    return np.sqrt(1 + x * x + y * y)
