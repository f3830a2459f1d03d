"""A Kinect in the manner of BlenSor: no image is matched, a mask of dots says where depth is.

Gschwandtner, Kwitt, Uhl and Pree, "BlenSor: Blender Sensor Simulation Toolbox", 2011. The
disparity f b / Z comes from geometry. A dot gives a value if enough of the dots around it are
seen where the same depth would put them: the projector reaches them, and what is there lies about
as far away. The value is rounded to 1/8 px and given to the few pixels around the dot. So depth
has the shadows of a projector, the device's steps and frayed edges, but no matching errors.

BlenSor's own values are kept where it documents them (its Kinect's default parameters): a window
of 9 x 9 px, more than 2/3 of its dots, an inlier distance of 0.05 m, 1/8 px, a fill radius of
3.1 px, no independent noise, and a smooth noise field of strength 0.25 over cells of 32 px.
Ours: the dots (a drawn pattern in place of a recorded one), that they stay fixed in the projector
and not in the image, that the field is band-limited, and its size in pixels: 0.06 px rms,
about that of gradient noise of strength 0.25.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from qs3.config.checks import check_ranges
from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.base import DepthFrame, check_depths, on_grid, window_of
from qs3.sensors.matching import Match
from qs3.sensors.matching.filters import Quantiser
from qs3.sensors.matching.triangulation import Triangulation
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.optics.point_light import white_lamp
from qs3.sensors.optics.smooth_field import smooth_field
from qs3.sensors.pixel_status import Reason
from qs3.sensors.renderers.base import Body, Renderer, Scene


@dataclass(frozen=True)
class DotMask:
    """A camera and a projector of dots beside it, without light: geometry decides.

    The defaults are Kinect v1's geometry.

    Attributes:
        width_px, height_px, focal_px: of the camera. A dot is one of the camera's pixels wide.
        baseline_m: projector minus camera along the camera's x.
        step_px: every step-th pixel of every step-th row gives a depth, the middle of each step.
        min_depth_m, max_depth_m: depths outside are dropped.
        pattern: the dots, one position a pixel, repeated over the whole field.
        window_px: side of the window around a dot, odd.
        min_share: more than this share of the window's dots must be seen ...
        inlier_m: ... with a depth that differs by less from the dot's own.
        fill_px: a dot's value is given to pixels up to so far away, the nearest dot's first.
        column_sigma_px: standard deviation of independent noise on the column of each dot.
        field_sigma_px: rms of the smooth noise field.
        field_cell_px: its shortest wave.
        quantiser: step of the disparity.
    """

    width_px: int = 640
    height_px: int = 480
    focal_px: float = 580.0
    baseline_m: float = 0.075
    step_px: int = 1
    min_depth_m: float = 0.7
    max_depth_m: float = 6.0
    pattern: Speckle = field(
        default_factory=lambda: Speckle(columns=633, rows=495, tiles=1, dot_px=1, seed=2)
    )
    window_px: int = 9
    min_share: float = 2 / 3
    inlier_m: float = 0.05
    fill_px: float = 3.1
    column_sigma_px: float = 0.0
    field_sigma_px: float = 0.06
    field_cell_px: float = 32.0
    quantiser: Quantiser = field(default_factory=lambda: Quantiser(8))

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "sensor.",
            **dict.fromkeys(("baseline_m", "inlier_m", "field_cell_px"), "> 0"),
            **dict.fromkeys(("fill_px", "column_sigma_px", "field_sigma_px"), ">= 0"),
            step_px=">= 1",
            window_px="odd >= 1",
            min_share="[0, 1)",
        )
        check_depths(self)

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera."""
        return Intrinsics.centred(self.width_px, self.height_px, self.focal_px)

    @property
    def triangulation(self) -> Triangulation:
        """From disparity to depth."""
        return Triangulation(
            self.focal_px, self.baseline_m, 0.0, self.min_depth_m, self.max_depth_m
        )

    def depth_step_m(self, depth_m: float) -> float:
        """Depth that one step of the quantiser makes: Z^2 / (steps f b)."""
        steps = self.quantiser.steps_per_px
        return depth_m**2 / (steps * self.focal_px * self.baseline_m) if steps else 0.0

    def scan(
        self,
        bodies: tuple[Body, ...],
        box_m: np.ndarray,
        world_from_camera: np.ndarray,
        renderer: Renderer,
        rng: np.random.Generator,
        explain: bool = False,
    ) -> DepthFrame | None:
        """Take one frame; see qs3.sensors.base.DepthSensor.

        Shadow is told apart whether asked for or not: the mask needs it anyway.
        """
        camera = Camera(self.intrinsics, world_from_camera)
        margin = self.window_px // 2 + int(self.fill_px) + 1
        window = window_of(box_m, camera, margin_px=margin)
        if window is None:
            return None
        # One render for both: what the projector reaches is what a white lamp there lights.
        lamp = white_lamp(camera.moved((self.baseline_m, 0.0, 0.0)).world_from_camera)
        (image,) = renderer.render(
            Scene(bodies, lamp),
            [Camera(self.intrinsics, world_from_camera, window)],
            seed=int(rng.integers(2**31)),
            geometry=[True],
        )
        clean = image.depth_m
        lit = image.radiance > 0
        exact = self.focal_px * self.baseline_m / clean.astype(np.float64)  # 0 where nothing is
        dots = self._dots(window, exact) & lit & np.isfinite(clean)
        good = dots & self._backed(window, exact, clean, lit, dots)
        noise = self.field_sigma_px * smooth_field(window, self.field_cell_px, rng)
        noise += self.column_sigma_px * rng.standard_normal(clean.shape)
        measured = np.where(good, exact + noise, np.nan).astype(np.float32)
        # A dot's value is rounded before it is handed to its neighbours or after: the same.
        match = Match.of(spread(measured, self.fill_px))
        depth, disparity, reason = self.triangulation.depth(match, self.quantiser, ())
        invalid = reason != Reason.OK
        reason[invalid & ~lit] = Reason.SHADOW
        reason[invalid & ~np.isfinite(clean)] = Reason.EMPTY

        first_col, cols = on_grid(window.left, window.width, self.step_px)
        first_row, rows = on_grid(window.top, window.height, self.step_px)
        grid = (rows, cols)
        pictures = {
            "left": np.where(dots, np.uint8(255), np.where(lit, np.uint8(40), np.uint8(0))),
            "disparity": disparity,
            "clean": clean,
        }
        if explain:
            pictures["lit"] = lit
        return DepthFrame(
            camera=camera,
            left=first_col,
            top=first_row,
            step_px=self.step_px,
            depth_m=np.ascontiguousarray(depth[grid]),
            clean_m=np.ascontiguousarray(clean[grid]),
            label=np.ascontiguousarray(image.label[grid]),
            cosine=np.ascontiguousarray(image.cosine[grid]),
            reason=np.ascontiguousarray(reason[grid]),
            images=pictures,
        )

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
    """Give each pixel the value of the nearest one that has any, up to a distance.

    Args:
        values: [h, w] float32, NaN where there is none.
        radius_px: how far.

    Returns:
        [h, w] float32; of several at the same distance the first in reading order counts.
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
