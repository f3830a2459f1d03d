"""The paper's sensor: two cameras, a speckle projector in the middle, block matching.

Chen et al., ECCV 2022, section 3.1: 1080 x 1080 pixels, baseline 10 cm, OpenCV's block
matching, depth down-sampled to 270 x 270. Focal length, pattern and matcher settings that
the paper does not state are those of the released scene (lens 50 mm on 36 mm: f = 1500 px;
slide 1266 x 990 scaled by 0.8; StereoBM with 160 disparities and block 19; 1 m < z < 6 m).

Repaired with respect to the released code: pixel centres (it is off by half a pixel and,
after its down-sampling, by up to two), and StereoBM's bias of 0.029 px.
"""

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge

from qs3.geometry.cameras import Camera, Window
from qs3.sensors.base import DepthFrame, Shot, TriangulatingSensor, window_of
from qs3.sensors.matching import Matcher, StereoBlockMatcher
from qs3.sensors.matching.base import for_picture
from qs3.sensors.optics.infrared import FilmicCamera, InfraredCamera
from qs3.sensors.optics.misalignment import Misalignment
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.optics.visibility import Reason
from qs3.sensors.renderers.base import Image, Projector
from qs3.utils.settings import Count, NotNegative, Positive, settings


@settings
class SpeckleStereo(TriangulatingSensor):
    """An active stereo depth camera; the projector is half-way between its two cameras.

    Attributes:
        step_px: every step-th pixel of every step-th row gives a depth (1080 / 4 = 270).
        tan_half_width: half the width of the projected slide at distance 1.
        ambient: radiance of a white surface in the fill light, which lowers the contrast.
        pattern: the slide.
        matcher: finds the left image in the right one.
        infrared: from radiance to grey values.
        projector_strength: radiance of a white surface under a lit dot at 1 m; at 16, white at
            4 m has radiance 1.
        sample_offset_px: first column and row that are kept; null: the middle of each step.
        centre_error_px: error of the principal point in back-projection, right and down. The
            released code has 0.5: it takes pixel centres for integers where they are halves,
            which shifts clouds by 0.5 Z / f (1.3 mm at 4 m).
        blind_left_px: columns at the left of the image that give no depth. OpenCV's StereoBM
            leaves num_disparities - 1 + block_size // 2 (168 px) empty; here the images are
            padded, so it loses none.
        misalignment: what the calibration of the two cameras leaves; by default nothing.
    """

    width_px: Count = 1080
    height_px: Count = 1080
    focal_px: Positive = 1500.0
    baseline_m: Positive = 0.1
    step_px: Count = 4
    min_depth_m: Positive = 1.0
    max_depth_m: Positive = 6.0
    tan_half_width: Positive = 0.625
    ambient: NotNegative = 0.15
    pattern: Speckle = field(default_factory=Speckle)
    matcher: Matcher = field(default_factory=StereoBlockMatcher)
    infrared: InfraredCamera | FilmicCamera = field(default_factory=InfraredCamera)
    projector_strength: Positive = 16.0
    sample_offset_px: Annotated[int, Ge(0)] | None = None
    centre_error_px: float = 0.0
    blind_left_px: Annotated[int, Ge(0)] = 0
    misalignment: Misalignment = field(default_factory=Misalignment)

    def __post_init__(self) -> None:
        super().__post_init__()
        assert (self.sample_offset_px or 0) < self.step_px, "sample_offset_px must be in a step"

    @property
    def margin_px(self) -> int:
        """Fattening puts values up to half a block outside the silhouette; misalignment more."""
        return self.matcher.reach_px + self.misalignment.reach_px

    def take(self, shot: Shot) -> DepthFrame | None:
        """See `DepthSensor.take`."""
        middle, right = shot.pose_at(self.baseline_m / 2), shot.pose_at(self.baseline_m)
        window = window_of(shot.box_m, Camera(self.intrinsics, right), margin_px=self.margin_px)
        if window is None:
            return None
        slide, strength = self.pattern.slide, self.projector_strength
        projector = Projector(middle, slide, self.tan_half_width, strength)
        cameras, seed = [shot.camera, Camera(self.intrinsics, right, window)], shot.seed()
        scene = shot.scene(projector, self.ambient)
        # Only the left image gets a depth.
        images = shot.renderer.render(scene, cameras, seed=seed, geometry=[True, False])
        windows = (shot.camera.rendered, window)
        canvas = self._canvas(*windows)
        gain, matcher = 1.0, self.matcher
        if isinstance(self.infrared, InfraredCamera):
            metered = self.infrared.metered(images[0], usual="object")
            gain = self.infrared.gain(images[0].radiance, metered)
            matcher = for_picture(matcher, self.infrared.noise(gain))
        radiance = self._seen(images, windows, canvas)
        ambient: list[np.ndarray] | list[None] = [None, None]
        if self.infrared.needs_ambient:
            # The same seed: the same places in each pixel.
            dim = shot.scene(None, self.ambient)
            others = shot.renderer.render(dim, cameras, seed=seed, geometry=[False, False])
            ambient = self._seen(others, windows, canvas)
        grey = [
            self.infrared.expose(total, gain, shot.rng, other)
            for total, other in zip(radiance, ambient, strict=True)
        ]
        match = matcher.match(grey[0], grey[1])
        if self.blind_left_px:
            blind = slice(0, max(0, self.blind_left_px - canvas.left))
            match.reason[:, blind], match.disparity[:, blind] = Reason.OUTSIDE, np.nan
        depth, disparity, reason = self.depth_of(match)
        seen = shot.camera.rendered
        inside = replace(seen, left=seen.left - canvas.left, top=seen.top - canvas.top).slices
        pictures = {
            "left": grey[0][inside],
            "right": grey[1][inside],
            "disparity": disparity[inside],
            "clean": images[0].depth_m,
        }
        reason = shot.explained(reason[inside], pictures, middle, right)
        at = shot.samples(self.step_px, self.sample_offset_px)
        k, error = self.intrinsics, self.centre_error_px
        believed = replace(k, cx_px=k.cx_px + error, cy_px=k.cy_px + error)
        return shot.frame(at.of(depth[inside]), at.of(reason), images[0], pictures, at, believed)

    def _seen(
        self, images: Sequence[Image], windows: Sequence[Window], canvas: Window
    ) -> list[np.ndarray]:
        """The radiance [h, w] of the left and the right image on the canvas, through the lenses."""
        left, right = (_place(*seen, canvas) for seen in zip(images, windows, strict=True))
        return [left, self.misalignment.seen(right, canvas)]

    def _canvas(self, left: Window, right: Window) -> Window:
        """Where both images lie side by side, with room for the matcher's reach around them.

        What is outside the rendered windows is dark. In a room a strip of background right of the
        object, whose disparity is smaller, has no match by it.
        """
        margin = 2 * self.matcher.reach_px
        first = min(left.left, right.left) - margin
        last = max(left.left + left.width, right.left + right.width) + margin
        top = min(left.top, right.top) - margin
        bottom = max(left.top + left.height, right.top + right.height) + margin
        return Window(first, top, last - first, bottom - top)


def _place(image: Image, window: Window, canvas: Window) -> np.ndarray:
    out = np.zeros((canvas.height, canvas.width), dtype=np.float32)
    row, col = window.top - canvas.top, window.left - canvas.left
    out[row : row + window.height, col : col + window.width] = image.radiance
    return out
