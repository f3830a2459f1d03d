"""Fringe projection: structured light with sinusoids, one camera and one projector.

N-step phase shifting with temporal unwrapping: slide n of P periods shows

    (1 + cos(2 pi P s + 2 pi n / N)) / 2,        0 <= s <= 1 across the slide,

and a pixel sees I_n = a + M cos(phase + 2 pi n / N). The phase follows from the discrete Fourier
sums of the I_n, whatever a (ambient light) and M (albedo, distance, blur) are; it is known up to
whole periods, which the next coarser fringes tell (Huntley and Saldner, Applied Optics 32(17),
1993). With noise of standard deviation sigma_n in each I_n, independent,

    sigma_phase = sqrt(2 / N) sigma_n / M,        sigma_s = sigma_phase / (2 pi P)

of the finest fringes. It holds with the mean variance where the noise depends on the signal, for
N >= 4 (shot noise is proportional to I_n, and the sum of cos sin^2 over the steps vanishes).

The camera's ray through u meets the plane of light that leaves the projector at x / z = x_p. The
projector looks the same way at a distance b from the camera, so x_p = x - b / Z with
x = (u - cx) / f, and Z = f b / d with the disparity d = f (x - x_p). So

    sigma_Z = Z^2 / b * 2 tan_half_width * sigma_s

A view costs one render and one exposure a slide, and one render to know where the renderer's
samples lie in their pixels. The scene must stand still meanwhile, as it does here.
"""

from dataclasses import field
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval

from qs3.sensors.base import DepthFrame, Shot, TriangulatingSensor
from qs3.sensors.matching import Match
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.visibility import Reason, first_reason, sample_centres
from qs3.sensors.renderers.base import Image, Projector, tangents
from qs3.utils.settings import NotNegative, Positive, settings


@settings
class FringeCode:
    """Which slides are thrown.

    Attributes:
        periods: across the slide, from coarse to fine; the first is at most 1, so that it is
            not ambiguous.
        steps: N, slides of each.
        columns, rows: of a slide. A renderer interpolates slides linearly, so a period needs at
            least 8 pixels; with 16 the sinusoid's error is 0.4 % (its harmonics 15 and 17).
    """

    periods: tuple[Positive, ...] = (1.0, 8.0, 64.0)
    steps: Annotated[int, Ge(3)] = 4
    columns: Annotated[int, Ge(2)] = 1024
    rows: Annotated[int, Ge(2)] = 768

    def __post_init__(self) -> None:
        assert self.periods == tuple(sorted(set(self.periods))), "code.periods must increase"
        assert self.periods[0] <= 1, "code.periods must begin with at most 1 period"
        assert self.periods[-1] * 8 <= self.columns, "a period needs 8 px of the slide"

    @cached_property
    def slides(self) -> np.ndarray:
        """[F, N, rows, columns] float32 in 0..1."""
        s = (np.arange(self.columns) + 0.5) / self.columns
        angle = (
            2 * np.pi * np.multiply.outer(np.array(self.periods), s)[:, None]
            + (2 * np.pi / self.steps) * np.arange(self.steps)[None, :, None]
        )
        wave = ((1 + np.cos(angle)) / 2).astype(np.float32)  # [F, N, length]
        return np.broadcast_to(wave[..., None, :], (*wave.shape[:2], self.rows, self.columns))

    def decode(self, exposures: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places on the slide, from `exposures` [F, N, h, w] in the order of `slides`.

        Returns:
            [h, w] float64 s; [F, h, w] modulation M in the exposures' units; [h, w] how far, in
            periods of the finer fringes, the least fitting pair of neighbouring fringes is apart,
            0..0.5.
        """
        angle = (2 * np.pi / self.steps) * np.arange(self.steps)
        real = np.einsum("n,fnhw->fhw", np.cos(angle), exposures, optimize=False)
        imaginary = -np.einsum("n,fnhw->fhw", np.sin(angle), exposures, optimize=False)
        phase = np.arctan2(imaginary, real)
        modulation = np.hypot(real, imaginary) * (2 / self.steps)
        turns = phase[0] / (2 * np.pi) % 1  # periods of the first fringes, counted from s = 0
        worst = np.zeros_like(turns)
        for level in range(1, len(self.periods)):
            fraction = phase[level] / (2 * np.pi)
            expected = turns * (self.periods[level] / self.periods[level - 1])
            whole = np.rint(expected - fraction)
            turns = whole + fraction
            worst = np.maximum(worst, np.abs(expected - turns))
        return turns / self.periods[-1], modulation, worst


@settings
class FringeProjection(TriangulatingSensor):
    """A camera and a projector of fringes to the right of it. All numbers are ours.

    Attributes:
        tan_half_width, projector_strength, ambient: as in SpeckleStereo.
        code: the slides.
        infrared: all exposures share one gain.
        min_modulation: pixels with a weaker modulation (grey values) at any fringes are dark.
        max_misfit: pixels where neighbouring fringes differ by more (in periods of the finer,
            0.5 accepts all) are ambiguous.
    """

    focal_px: Positive = 600.0
    baseline_m: Positive = 0.15
    min_depth_m: Positive = 0.4
    tan_half_width: Positive = 0.6
    projector_strength: Positive = 1.0
    ambient: NotNegative = 0.01
    code: FringeCode = field(default_factory=FringeCode)
    infrared: InfraredCamera = field(default_factory=InfraredCamera)
    min_modulation: NotNegative = 10.0
    max_misfit: Annotated[float, Interval(gt=0, le=0.5)] = 0.35

    def __post_init__(self) -> None:
        super().__post_init__()
        assert not self.infrared.needs_ambient, "ambient_speckles=false is for speckle projectors"

    @property
    def margin_px(self) -> int:
        """A pixel."""
        return 1

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`.

        The image "left" is the first exposure of the finest fringes, "exposures" has all.
        """
        pose, seed = shot.pose_at(self.baseline_m), shot.seed()
        images = self._render(shot, pose, seed)
        centres = sample_centres(shot.camera, shot.renderer, seed)
        seen = images[0]
        hit = np.isfinite(seen.depth_m)
        radiance = np.stack([image.radiance for image in images])
        gain = self.infrared.gain(radiance.max(axis=0), self.infrared.metered(seen, usual="image"))
        grey = np.stack([self.infrared.expose(image, gain, shot.rng) for image in radiance])
        exposures = grey.reshape(len(self.code.periods), self.code.steps, *grey.shape[1:])

        match, modulation = self._match(exposures, centres)
        depth, disparity, reason = self.depth_of(match)
        pictures = {
            "left": exposures[-1, 0],
            "disparity": disparity,
            "clean": seen.depth_m,
            "modulation": modulation,
            "exposures": grey,
        }
        invalid = reason != Reason.OK
        reason[invalid & self._off_slide(shot, seen.depth_m)] = Reason.OUTSIDE
        reason[invalid & ~hit] = Reason.EMPTY
        return shot.frame(depth, shot.explained(reason, pictures, pose), seen, pictures)

    def _render(self, shot: Shot, world_from_projector: np.ndarray, seed: int) -> list[Image]:
        """One image a slide, coarse fringes first; the first has the geometry too."""
        images: list[Image] = []
        for slide in self.code.slides.reshape(-1, self.code.rows, self.code.columns):
            projector = Projector(
                world_from_projector,
                np.ascontiguousarray(slide),
                self.tan_half_width,
                self.projector_strength,
            )
            scene = shot.scene(projector, self.ambient)
            # One seed: a pixel sees the same piece of the surface in every exposure.
            images += shot.renderer.render(scene, [shot.camera], seed=seed, geometry=[not images])
        return images

    def _off_slide(self, shot: Shot, depth_m: np.ndarray) -> np.ndarray:
        """[h, w] bool: the projector's slide ends before the surface; False where none is."""
        x, y = tangents(shot.camera)
        x = x - self.baseline_m / depth_m
        tan_half_height = self.tan_half_width * self.code.rows / self.code.columns
        return (np.abs(x) > self.tan_half_width) | (np.abs(y) > tan_half_height)

    def _match(self, exposures: np.ndarray, centres: np.ndarray) -> tuple[Match, np.ndarray]:
        """Disparity of [F, N, h, w] uint8 exposures, and [h, w] modulation of the finest.

        `centres` [h, w] are the columns in px that were really looked at.
        """
        place, modulation, misfit = self.code.decode(exposures.astype(np.float64))
        k = self.intrinsics
        on_slide = self.tan_half_width * (2 * place - 1)  # x / z in the projector
        disparity = (centres - k.cx_px) - k.focal_px * on_slide
        causes = {
            Reason.DARK: modulation.min(axis=0) < self.min_modulation,
            Reason.SATURATED: exposures.max(axis=(0, 1)) == 255,
            Reason.AMBIGUOUS: misfit > self.max_misfit,
        }
        why_not = first_reason(causes, Reason.OK)
        valid = why_not == Reason.OK
        found = np.where(valid, disparity, np.nan).astype(np.float32)
        return Match.of(found, why_not), modulation[-1]
