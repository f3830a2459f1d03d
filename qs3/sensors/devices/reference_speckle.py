"""Kinect-v1-like sensor: one camera matched against a stored image of the pattern.

The projector sits at a distance b beside the camera. A dot at slide position s (x / z in
the projector's frame) is seen at u = f (b / Z + s) + cx, and in the reference image, which
was stored with a plane at Z_ref, at u_ref = f (b / Z_ref + s) + cx. So the disparity
u - u_ref = f b (1 / Z - 1 / Z_ref) (Khoshelham and Elberink, Sensors 2012, eq. 1 to 5).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from qs3.errors import ConfigError
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.sensors.base import DepthFrame, check_depths, window_of
from qs3.sensors.matching import Matcher, ReferenceMatcher
from qs3.sensors.matching.filters import PostFilter, Quantiser
from qs3.sensors.matching.triangulation import Triangulation
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.patterns import Slide, Speckle
from qs3.sensors.optics.visibility import explained, reached_from
from qs3.sensors.renderers.base import Body, Projector, Renderer, Scene


@dataclass(frozen=True)
class ReferenceSpeckle:
    """A single infrared camera and a projector beside it.

    Kinect v1: 640 x 480 px, f about 580 px, baseline about 75 mm (Konolige and Mihelich,
    ROS kinect_calibration/technical); pattern of 3 x 3 tiles of 211 x 165 positions.

    Attributes:
        width_px, height_px, focal_px: of the camera.
        baseline_m: projector minus camera along the camera's x.
        reference_m: distance of the plane whose image is stored. It places the search range.
        min_depth_m, max_depth_m: depths outside are dropped.
        tan_half_width: half the width of the slide at distance 1.
        ambient: as in SpeckleStereo, relative to the pattern on white at `reference_m`.
        pattern, matcher, infrared, quantiser, filters: as in SpeckleStereo; ReferenceMatcher
            has a quantiser of its own.
    """

    width_px: int = 640
    height_px: int = 480
    focal_px: float = 580.0
    baseline_m: float = 0.075
    reference_m: float = 1.6
    min_depth_m: float = 0.7
    max_depth_m: float = 6.0
    tan_half_width: float = 0.62
    ambient: float = 0.25
    pattern: Slide = field(
        default_factory=lambda: Speckle(columns=211, rows=165, tiles=3, dot_px=1, seed=1)
    )
    matcher: Matcher = field(default_factory=ReferenceMatcher)
    infrared: InfraredCamera = field(
        default_factory=lambda: InfraredCamera(electrons_at_white=4000.0, read_noise_e=40.0)
    )
    quantiser: Quantiser = field(default_factory=Quantiser)
    filters: tuple[PostFilter, ...] = ()

    def __post_init__(self) -> None:
        check_depths(self)
        low, high = (self.disparity(z) for z in (self.max_depth_m, self.min_depth_m))
        first = self.matcher.min_disparity
        last = first + self.matcher.num_disparities - 1
        if low < first or high > last:
            raise ConfigError(
                f"depths {self.min_depth_m} to {self.max_depth_m} m need disparities "
                f"{low:.1f} to {high:.1f} px, but the matcher searches {first} to {last}: "
                "change sensor.reference_m or the matcher's range"
            )

    def disparity(self, depth_m: float) -> float:
        """Disparity in px of a plane at `depth_m`."""
        return self.focal_px * self.baseline_m * (1 / depth_m - 1 / self.reference_m)

    def depth_step_m(self, depth_m: float) -> float:
        """Depth that one step of the quantiser makes: Z^2 / (steps f b)."""
        steps = self.quantiser.steps_per_px or getattr(self.matcher, "steps_per_px", 0)
        return depth_m**2 / (steps * self.focal_px * self.baseline_m) if steps else 0.0

    @property
    def triangulation(self) -> Triangulation:
        """From disparity to depth; a point at `reference_m` has disparity 0."""
        offset = self.focal_px * self.baseline_m / self.reference_m
        return Triangulation(
            self.focal_px, self.baseline_m, offset, self.min_depth_m, self.max_depth_m
        )

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera."""
        return Intrinsics.centred(self.width_px, self.height_px, self.focal_px)

    @cached_property
    def reference(self) -> np.ndarray:
        """[height_px, width_px] float32 stored image, 0..255: the slide on the plane.

        Computed from the geometry with 8 x 8 samples a pixel, without noise: a device
        averages many frames for it.
        """
        slide = self.pattern.slide
        rows, cols = slide.shape
        k, fine = self.intrinsics, 8
        shift = (np.arange(fine) + 0.5) / fine - 0.5
        u = (np.arange(self.width_px)[:, None] + shift).ravel()
        v = (np.arange(self.height_px)[:, None] + shift).ravel()
        slide_px = cols / (2 * self.tan_half_width)  # slide pixels per unit of x / z
        x = (u - k.cx_px) / k.focal_px - self.baseline_m / self.reference_m
        y = (v - k.cy_px) / k.focal_px
        col = np.floor(x * slide_px + cols / 2).astype(int)
        row = np.floor(y * slide_px + rows / 2).astype(int)
        seen = np.zeros((len(row), len(col)), dtype=np.float32)
        in_col, in_row = (col >= 0) & (col < cols), (row >= 0) & (row < rows)
        seen[np.ix_(in_row, in_col)] = slide[np.ix_(row[in_row], col[in_col])]
        image = seen.reshape(self.height_px, fine, self.width_px, fine).mean(axis=(1, 3))
        if self.infrared.psf_px:  # it was stored through the same lens
            image = cv2.GaussianBlur(image, (0, 0), self.infrared.psf_px)
        return np.ascontiguousarray(image * 255, dtype=np.float32)

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
        camera = Camera(self.intrinsics, world_from_camera)
        window = window_of(box_m, camera, margin_px=2 * self.matcher.reach_px + 1)
        if window is None:
            return None
        projector = Projector(
            camera.moved((self.baseline_m, 0.0, 0.0)).world_from_camera,
            self.pattern.slide,
            self.tan_half_width,
            strength=self.reference_m**2,  # white at reference_m has radiance 1
        )
        (image,) = renderer.render(
            Scene(bodies, projector, self.ambient),
            [Camera(self.intrinsics, world_from_camera, window)],
            seed=int(rng.integers(2**31)),
            geometry=[True],
        )
        gain = self.infrared.gain(image.radiance, np.isfinite(image.depth_m))
        grey = self.infrared.expose(image.radiance, gain, rng)
        rows, columns = window.slices
        match = self.matcher.match(grey, self.reference[rows], window.left)
        depth, disparity, reason = self.triangulation.depth(match, self.quantiser, self.filters)
        pictures = {"left": grey, "disparity": disparity, "clean": image.depth_m}
        if explain:
            pictures["reference"] = self.reference[rows, columns]
            here = Camera(self.intrinsics, world_from_camera, window)
            lit = reached_from(bodies, here, projector.world_from_projector, renderer)
            reason = explained(reason, image.depth_m, lit, None)
            pictures["lit"] = lit
        return DepthFrame(
            camera=camera,
            left=window.left,
            top=window.top,
            step_px=1,
            depth_m=depth,
            clean_m=image.depth_m,
            label=image.label,
            cosine=image.cosine,
            reason=reason,
            images=pictures,
        )
