"""Kinect-v1-like sensor: one camera matched against a stored image of the pattern.

The projector sits at a distance b to the right of the camera. A dot at slide position s (x / z in
the projector's frame) is seen at u = f (b / Z + s) + cx, and in the reference image, which
was stored with a plane at Z_ref, at u_ref = f (b / Z_ref + s) + cx. So the disparity
u - u_ref = f b (1 / Z - 1 / Z_ref) (Khoshelham and Elberink, Sensors 2012, eq. 1 to 5).
"""

from dataclasses import field
from functools import cached_property

import cv2
import numpy as np

from qs3.sensors.base import DepthFrame, Shot, TriangulatingSensor
from qs3.sensors.matching import Matcher, ReferenceMatcher
from qs3.sensors.matching.base import for_picture
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.renderers.base import Projector
from qs3.utils.settings import NotNegative, Positive, settings


@settings
class ReferenceSpeckle(TriangulatingSensor):
    """A single infrared camera and a projector next to it.

    Kinect v1: 640 x 480 px, f about 580 px, baseline about 75 mm (Konolige and Mihelich,
    ROS kinect_calibration/technical); pattern of 3 x 3 tiles of 211 x 165 positions.

    Attributes:
        reference_m: distance of the plane whose image is stored. It places the search range.
        tan_half_width: half the width of the slide at distance 1.
        ambient: as in SpeckleStereo, relative to the pattern on white at `reference_m`.
        pattern, matcher, infrared: as in SpeckleStereo.
    """

    reference_m: Positive = 1.6
    tan_half_width: Positive = 0.62
    ambient: NotNegative = 0.25
    pattern: Speckle = field(
        default_factory=lambda: Speckle(columns=211, rows=165, tiles=3, dot_px=1, seed=1)
    )
    matcher: Matcher = field(default_factory=ReferenceMatcher)
    infrared: InfraredCamera = field(
        default_factory=lambda: InfraredCamera(electrons_at_white=4000.0, read_noise_e=40.0)
    )

    @property
    def zero_disparity_px(self) -> float:
        """Disparity f b / Z of a point at `reference_m`."""
        return self.focal_px * self.baseline_m / self.reference_m

    @property
    def margin_px(self) -> int:
        """Twice the matcher's reach, and a pixel."""
        return 2 * self.matcher.reach_px + 1

    @cached_property
    def reference(self) -> np.ndarray:
        """[height_px, width_px] float32 stored image, 0..255: the slide on the plane.

        With 8 x 8 samples a pixel and without noise: a device averages many frames for it.
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
        dark = np.pad(slide, (0, 1))  # the last row and column are what lies beside the slide
        lit = dark[row.clip(-1, rows)].reshape(self.height_px, fine, -1).sum(axis=1)
        image = lit[:, col.clip(-1, cols)].reshape(self.height_px, self.width_px, fine).sum(axis=2)
        image /= fine**2
        if self.infrared.psf_px:  # it was stored through the same lens
            image = cv2.GaussianBlur(image, (0, 0), self.infrared.psf_px)
        return np.ascontiguousarray(image * 255, dtype=np.float32)

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`."""
        projector = Projector(
            shot.pose_at(self.baseline_m),
            self.pattern.slide,
            self.tan_half_width,
            strength=self.reference_m**2,  # white at reference_m has radiance 1
        )
        seed = shot.seed()
        ambient = None
        image = shot.image(projector, self.ambient, seed)
        if self.infrared.needs_ambient:
            ambient = shot.image(None, self.ambient, seed).radiance
        gain = self.infrared.gain(image.radiance, self.infrared.metered(image, usual="image"))
        grey = self.infrared.expose(image.radiance, gain, shot.rng, ambient)
        rows, columns = shot.camera.rendered.slices
        matcher = for_picture(self.matcher, self.infrared.noise(gain))
        match = matcher.match(grey, self.reference[rows], shot.camera.rendered.left)
        depth, disparity, reason = self.depth_of(match)
        pictures = {"left": grey, "disparity": disparity, "clean": image.depth_m}
        if shot.explain:
            pictures["reference"] = self.reference[rows, columns]
        reason = shot.explained(reason, pictures, projector.world_from_projector)
        return shot.frame(depth, reason, image, pictures)
