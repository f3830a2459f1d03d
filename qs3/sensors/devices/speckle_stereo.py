"""The paper's sensor: two cameras, a speckle projector in the middle, block matching.

Chen et al., ECCV 2022, section 3.1: 1080 x 1080 pixels, baseline 10 cm, OpenCV's block
matching, depth down-sampled to 270 x 270. Focal length, pattern and matcher settings that
the paper does not state are those of the released scene (lens 50 mm on 36 mm: f = 1500 px;
slide 1266 x 990 scaled by 0.8; StereoBM with 160 disparities and block 19; 1 m < z < 6 m).

Repaired with respect to the released code: pixel centres (it is off by half a pixel and,
after its down-sampling, by up to two), and StereoBM's bias of 0.029 px.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError
from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.base import DepthFrame, check_depths, window_of
from qs3.sensors.matching import Matcher, StereoBlockMatcher
from qs3.sensors.matching.filters import PostFilter, Quantiser
from qs3.sensors.matching.triangulation import Triangulation
from qs3.sensors.optics.blender_filmic import FilmicCamera
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.patterns import Slide, Speckle
from qs3.sensors.optics.visibility import explained, reached_from
from qs3.sensors.pixel_status import Reason
from qs3.sensors.renderers.base import Body, Image, Projector, Renderer, Scene


@dataclass(frozen=True)
class SpeckleStereo:
    """An active stereo depth camera.

    Attributes:
        width_px, height_px, focal_px: of both cameras.
        baseline_m: right camera minus left camera along x; the projector is half-way.
        step_px: every step-th pixel of every step-th row gives a depth (1080 / 4 = 270).
        min_depth_m, max_depth_m: depths outside are dropped.
        tan_half_width: half the width of the projected slide at distance 1.
        ambient: radiance of the fill light relative to the pattern's on a white surface
            at 4 m; it lowers the contrast.
        pattern: the slide.
        matcher: finds the left image in the right one.
        infrared: from radiance to grey values.
        quantiser: step of the disparity; StereoBM's own is 1/16 px.
        filters: applied to the disparity in this order, before the quantiser.
        projector_strength: radiance of a white surface under a lit dot at 1 m; at 16, white at
            4 m has radiance 1. `ambient` is in the same units.
        sample_offset_px: first column and row that are kept; null: the middle of each step.
        centre_error_px: error of the principal point in back-projection, right and down. The
            released code has 0.5: it takes pixel centres for integers where they are halves,
            which shifts clouds by 0.5 Z / f (1.3 mm at 4 m).
        blind_left_px: columns at the left of the image that give no depth. OpenCV's StereoBM
            leaves num_disparities - 1 + block_size // 2 (168 px) empty; here the images are
            padded, so it loses none.
    """

    width_px: int = 1080
    height_px: int = 1080
    focal_px: float = 1500.0
    baseline_m: float = 0.1
    step_px: int = 4
    min_depth_m: float = 1.0
    max_depth_m: float = 6.0
    tan_half_width: float = 0.625
    ambient: float = 0.15
    pattern: Slide = field(default_factory=Speckle)
    matcher: Matcher = field(default_factory=StereoBlockMatcher)
    infrared: InfraredCamera | FilmicCamera = field(default_factory=InfraredCamera)
    quantiser: Quantiser = field(default_factory=Quantiser)
    filters: tuple[PostFilter, ...] = ()
    projector_strength: float = 16.0
    sample_offset_px: int | None = None
    centre_error_px: float = 0.0
    blind_left_px: int = 0

    def __post_init__(self) -> None:
        check_ranges(self, "sensor.", baseline_m="> 0", step_px=">= 1", projector_strength="> 0")
        check_depths(self)
        if self.sample_offset_px is not None and not 0 <= self.sample_offset_px < self.step_px:
            raise ConfigError(
                f"sensor.sample_offset_px must be null or in 0..{self.step_px - 1} (step_px is "
                f"{self.step_px}), got {self.sample_offset_px}"
            )
        check_ranges(self, "sensor.", blind_left_px=f"[0, {self.width_px})")
        end = self.matcher.min_disparity + self.matcher.num_disparities
        if self.focal_px * self.baseline_m / self.min_depth_m > end:
            nearest = self.focal_px * self.baseline_m / end
            raise ConfigError(
                f"sensor.min_depth_m {self.min_depth_m} is nearer than the matcher reaches: "
                f"with disparities up to {end} it is {nearest:.2f} m"
            )

    @property
    def triangulation(self) -> Triangulation:
        """From disparity to depth."""
        return Triangulation(
            self.focal_px, self.baseline_m, 0.0, self.min_depth_m, self.max_depth_m
        )

    def depth_step_m(self, depth_m: float) -> float:
        """Depth that one step of the disparity makes: Z^2 q / (f b); OpenCV's q is 1/16 px."""
        steps = self.quantiser.steps_per_px or 16
        return depth_m**2 / (steps * self.focal_px * self.baseline_m)

    def scan(
        self,
        bodies: tuple[Body, ...],
        box_m: np.ndarray,
        world_from_camera: np.ndarray,
        renderer: Renderer,
        rng: np.random.Generator,
        explain: bool = False,
    ) -> DepthFrame | None:
        """Take one frame; see qs3.sensors.base.DepthSensor."""
        intrinsics = Intrinsics.centred(self.width_px, self.height_px, self.focal_px)
        left = Camera(intrinsics, world_from_camera)
        right = left.moved((self.baseline_m, 0.0, 0.0))
        # Fattening puts values up to half a block outside the silhouette.
        reach = self.matcher.reach_px
        left_window = window_of(box_m, left, margin_px=reach)
        right_window = window_of(box_m, right, margin_px=reach)
        if left_window is None or right_window is None:
            return None

        middle = left.moved((self.baseline_m / 2, 0.0, 0.0)).world_from_camera
        projector = Projector(
            middle,
            self.pattern.slide,
            self.tan_half_width,
            strength=self.projector_strength,
        )
        images = renderer.render(
            Scene(bodies, projector, self.ambient),
            [
                Camera(intrinsics, left.world_from_camera, left_window),
                Camera(intrinsics, right.world_from_camera, right_window),
            ],
            seed=int(rng.integers(2**31)),
            geometry=[True, False],  # only the left image gets a depth
        )

        canvas = self._canvas(left_window, right_window)
        gain = self.infrared.gain(images[0].radiance, images[0].label > 0)
        grey = [
            self.infrared.expose(_place(image, window, canvas), gain, rng)
            for image, window in zip(images, (left_window, right_window), strict=True)
        ]
        match = self.matcher.match(grey[0], grey[1])
        if self.blind_left_px:
            blind = slice(0, max(0, self.blind_left_px - canvas.left))
            match.reason[:, blind], match.disparity[:, blind] = Reason.OUTSIDE, np.nan
        depth, disparity, reason = self.triangulation.depth(match, self.quantiser, self.filters)

        inside = Window(
            left_window.left - canvas.left,
            left_window.top - canvas.top,
            left_window.width,
            left_window.height,
        ).slices
        pictures = {
            "left": grey[0][inside],
            "right": grey[1][inside],
            "disparity": disparity[inside],
            "clean": images[0].depth_m,
        }
        reason = reason[inside]
        if explain:
            camera = Camera(intrinsics, left.world_from_camera, left_window)
            lit = reached_from(bodies, camera, middle, renderer)
            seen = reached_from(bodies, camera, right.world_from_camera, renderer)
            reason = explained(reason, images[0].depth_m, lit, seen)
            pictures |= {"lit": lit, "seen": seen}

        # Samples lie on one grid over the whole image, whatever the window.
        offset = self.sample_offset_px
        if offset is None:
            offset = self.step_px // 2
        first_col = _first_on_grid(left_window.left, self.step_px, offset)
        first_row = _first_on_grid(left_window.top, self.step_px, offset)
        grid = (
            slice(first_row - left_window.top, None, self.step_px),
            slice(first_col - left_window.left, None, self.step_px),
        )
        return DepthFrame(
            camera=Camera(self._believed, left.world_from_camera),
            left=first_col,
            top=first_row,
            step_px=self.step_px,
            depth_m=depth[inside][grid],
            clean_m=images[0].depth_m[grid],
            label=images[0].label[grid],
            cosine=images[0].cosine[grid],
            reason=reason[grid],
            images=pictures,
        )

    @property
    def _believed(self) -> Intrinsics:
        """What back-projection takes for the intrinsics."""
        true = Intrinsics.centred(self.width_px, self.height_px, self.focal_px)
        error = self.centre_error_px
        return replace(true, cx_px=true.cx_px + error, cy_px=true.cy_px + error)

    def _canvas(self, left: Window, right: Window) -> Window:
        """Where both images lie side by side, with room for the matcher's reach around them.

        What is outside the rendered windows is dark, as it is in the render: nothing is there.
        """
        margin = 2 * self.matcher.reach_px
        first = min(left.left, right.left) - margin
        last = max(left.left + left.width, right.left + right.width) + margin
        top = min(left.top, right.top) - margin
        bottom = max(left.top + left.height, right.top + right.height) + margin
        return Window(first, top, last - first, bottom - top)


def _place(image: Image, window: Window, canvas: Window) -> np.ndarray:
    """The radiance of `window` on a dark canvas; pixels that see nothing are dark too."""
    out = np.zeros((canvas.height, canvas.width), dtype=np.float32)
    row, col = window.top - canvas.top, window.left - canvas.left
    out[row : row + window.height, col : col + window.width] = image.radiance
    return out


def _first_on_grid(start: int, step: int, offset: int) -> int:
    """The smallest x >= start with x % step == offset."""
    return start + (offset - start) % step
