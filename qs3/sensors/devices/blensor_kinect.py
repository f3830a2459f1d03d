"""A Kinect in the manner of BlenSor: no image is matched, a mask of dots says where depth is.

Gschwandtner, Kwitt, Uhl and Pree, "BlenSor: Blender Sensor Simulation Toolbox", 2011. The
disparity f b / Z comes from geometry. A dot gives a value if enough of the dots around it are
seen where the same depth would put them: the projector reaches them, and what is there lies about
as far away. The value is rounded to 1/8 px and given to the few pixels around the dot. So depth
has the shadows of a projector, the device's steps and frayed edges, but no matching errors.

Values are BlenSor's where it documents them (its Kinect's default parameters). Ours: the dots (a
drawn pattern in place of a recorded one), that they stay fixed in the projector and not in the
image, that the noise field is band-limited, and its size in pixels: 0.06 px rms, about that of
gradient noise of strength 0.25.
"""

from dataclasses import field
from itertools import product
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Interval

from qs3.geometry.cameras import Window
from qs3.sensors.base import DepthFrame, Shot, TriangulatingSensor
from qs3.sensors.matching import Match
from qs3.sensors.matching.filters import Quantiser
from qs3.sensors.optics.misalignment import smooth_field
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.optics.visibility import explained, white_lamp
from qs3.utils.settings import Count, IsOdd, NotNegative, Positive, settings


@settings
class DotMask(TriangulatingSensor):
    """A camera and a projector of dots next to it, without light: geometry decides.

    The defaults are Kinect v1's geometry.

    Attributes:
        step_px: every step-th pixel of every step-th row gives a depth, the middle of each step.
        pattern: the dots, one position a pixel of the camera, repeated over the whole field.
        window_px: side of the window around a dot, odd.
        min_share: more than this share of the window's dots must be seen ...
        inlier_m: ... with a depth that differs by less from the dot's own.
        fill_px: a dot's value is given to pixels up to so far away, the nearest dot's first.
        column_sigma_px: standard deviation of independent noise on the column of each dot.
        field_sigma_px: rms of the smooth noise field.
        field_cell_px: its shortest wave.
    """

    sees_light: ClassVar[bool] = False
    step_px: Count = 1
    pattern: Speckle = field(
        default_factory=lambda: Speckle(columns=633, rows=495, tiles=1, dot_px=1, seed=2)
    )
    window_px: Annotated[int, Ge(1), IsOdd] = 9
    min_share: Annotated[float, Interval(ge=0, lt=1)] = 2 / 3
    inlier_m: Positive = 0.05
    fill_px: NotNegative = 3.1
    column_sigma_px: NotNegative = 0.0
    field_sigma_px: NotNegative = 0.06
    field_cell_px: Positive = 32.0
    quantiser: Quantiser = field(default_factory=lambda: Quantiser(8))

    @property
    def margin_px(self) -> int:
        """Half a window, and how far values are spread."""
        return self.window_px // 2 + int(self.fill_px) + 1

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`. Shadow is always explained: the mask needs it anyway."""
        window = shot.camera.rendered
        # One render for both: what the projector reaches is what a white lamp there lights.
        image = shot.image(white_lamp(shot.pose_at(self.baseline_m)))
        clean, lit = image.depth_m, image.radiance > 0
        exact = self.focal_px * self.baseline_m / clean.astype(np.float64)  # 0 where nothing is
        dots = self._dots(window, exact) & lit & np.isfinite(clean)
        good = dots & self._backed(window, exact, clean, lit, dots)
        noise = self.field_sigma_px * smooth_field(window, self.field_cell_px, shot.rng)
        noise += self.column_sigma_px * shot.rng.standard_normal(clean.shape)
        measured = np.where(good, exact + noise, np.nan).astype(np.float32)
        # A dot's value is rounded before it is handed to its neighbours or after: the same.
        depth, disparity, reason = self.depth_of(Match.of(spread(measured, self.fill_px)))
        reason = explained(reason, clean, lit, None)
        pictures = {
            "left": np.where(dots, np.uint8(255), np.where(lit, np.uint8(40), np.uint8(0))),
            "disparity": disparity,
            "clean": clean,
        }
        if shot.explain:
            pictures["lit"] = lit
        at = shot.samples(self.step_px)
        return shot.frame(at.of(depth), at.of(reason), image, pictures, at)

    def _mask(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Whether there is a dot at a row and column of the projector, repeated for ever."""
        slide = self.pattern.slide
        return slide[rows % slide.shape[0], cols % slide.shape[1]] > 0

    def _dots(self, window: Window, exact: np.ndarray) -> np.ndarray:
        """[h, w] bool: pixels whose ray, seen from the projector, is one of a dot."""
        u = window.left + np.arange(window.width)
        v = window.top + np.arange(window.height)
        # The camera's column u at depth Z is the projector's column u - f b / Z.
        return self._mask(v[:, None], np.rint(u - exact).astype(np.int64))

    def _backed(
        self,
        window: Window,
        exact: np.ndarray,
        clean: np.ndarray,
        lit: np.ndarray,
        dots: np.ndarray,
    ) -> np.ndarray:
        """[h, w] bool: dots whose window shows enough of the dots that belong there."""
        rows, cols = np.nonzero(dots)
        depth = clean[rows, cols]
        row = window.top + rows
        col = np.rint(window.left + cols - exact[rows, cols]).astype(np.int64)
        half = self.window_px // 2
        deep = np.pad(np.where(lit, clean, np.float32(np.inf)), half, constant_values=np.inf)
        expected = np.zeros(len(rows), dtype=np.int64)
        seen = np.zeros(len(rows), dtype=np.int64)
        for dv, du in product(range(-half, half + 1), repeat=2):
            wanted = self._mask(row + dv, col + du)
            near = np.abs(deep[rows + half + dv, cols + half + du] - depth) < self.inlier_m
            expected += wanted
            seen += wanted & near
        out = np.zeros_like(dots)
        out[rows, cols] = seen > self.min_share * expected
        return out


def spread(values: np.ndarray, radius_px: float) -> np.ndarray:
    """Give each pixel of [h, w] the value of the nearest one that is not NaN, up to a distance.

    Of several at the same distance the first in reading order counts.
    """
    reach = int(radius_px)
    height, width = values.shape
    padded = np.pad(values, reach, constant_values=np.nan)
    steps = [
        (dv, du)
        for dv, du in product(range(-reach, reach + 1), repeat=2)
        if dv * dv + du * du <= radius_px**2
    ]
    out = np.full_like(values, np.nan)
    for dv, du in sorted(steps, key=lambda at: (at[0] ** 2 + at[1] ** 2, at)):
        there = padded[reach + dv : reach + dv + height, reach + du : reach + du + width]
        out = np.where(np.isnan(out), there, out)
    return out
