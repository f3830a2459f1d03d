"""Time of flight: the phase of modulated light, per pixel.

A lamp next to the lens shines with an intensity modulated at f. Light that went to a surface
and back, s metres in all, is late by the phase 2 pi f s / c. A pixel collects it in four
buckets, a quarter of a period apart; with K electrons a unit of radiance, contrast C, radiance
R of the lamp's light and radiance B of all other light, bucket m holds on average

    I_m = K (R + B) + A cos(phase - m pi / 2),        A = K C |V|,

where V is the mean over the pixel's area of R exp(i phase): a pixel on an edge adds the
phasors of both surfaces and reports a place between or beyond them ("flying" or mixed pixels).

Noise. Each bucket has the variance of its shot noise, I_m, and of the read-out, r^2. The two
differences I_0 - I_2 = 2 A cos(phase) and I_1 - I_3 = 2 A sin(phase) have both the variance 2 N
with N = K (R + B) + r^2, because I_0 + I_2 = I_1 + I_3 = 2 K (R + B). So to first order

    sigma_phase = sqrt(2 N) / (2 A),
    sigma_d = c / (4 pi f) sigma_phase = c / (4 pi f) sqrt(N) / (sqrt(2) A)

(Lange and Seitz, IEEE J. Quantum Electronics 37(3), 2001, have the same law). It grows with the
distance where the lamp's shot noise rules, and with its square where the read-out or other light
does. Several frequencies, each weighed with 1 / sigma^2, give the sigma of
f = sqrt(f_1^2 + f_2^2 + ...). One frequency cannot tell d from d + c / (2 f).

Not simulated: light that bounces between surfaces (multipath), because renderers do not say how far
it went; higher harmonics of the modulation; motion between buckets.
"""

import math
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval, MinLen

from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.base import DepthFrame, DepthSensor, Shot
from qs3.sensors.optics.visibility import Reason, first_reason, white_lamp
from qs3.sensors.renderers.base import Image, Scene
from qs3.utils.settings import Count, IsOdd, NotNegative, Positive, settings

SPEED_OF_LIGHT = 299_792_458.0
"""Metres a second."""


@settings
class TimeOfFlight(DepthSensor):
    """An amplitude-modulated continuous-wave time-of-flight camera.

    The defaults put white at the noise of published cameras: on albedo 0.8 sigma is 1.1 mm at
    1 m and 4.9 mm at 3.5 m; BlenderProc's fit for Azure Kinect is 0.5 mm + 1 mm/m (z - 0.5 m),
    and Tolgyessy et al. (Sensors 21(2):413, 2021) find at most 17 mm up to 3.5 m. Frequencies
    of 16 and 80 MHz are two of Kinect v2's three; the other numbers are ours.

    Attributes:
        lamp_offset_m: lamp minus camera along the camera's x. The device knows it.
        frequencies_hz: one, or more that are measured in turn; the first is unwrapped by the
            others, and each counts by its noise. They need a large common divisor; see `unwrapped`.
        contrast: demodulation contrast C at all frequencies.
        electrons_at_1m: K for the lamp: electrons a bucket of white at 1 m, the sum over a
            frame's sub-exposures.
        read_noise_e: r, standard deviation a bucket.
        full_well_e: a bucket that holds more is saturated.
        ambient: radiance of other light, white at 1 m under the lamp being 1.
        min_amplitude_e: a pixel whose amplitude is lower at any frequency is dark.
        max_disagreement_m: a pixel whose frequencies give distances that differ by more from
            their mean is dropped.
        supersampling: phasors of so many by so many places are added in a pixel, odd.
        min_depth_m, max_depth_m: depths outside are dropped.
    """

    width_px: Count = 320
    height_px: Count = 288
    focal_px: Positive = 252.0
    lamp_offset_m: float = 0.02
    frequencies_hz: Annotated[tuple[Annotated[float, Ge(1)], ...], MinLen(1)] = (80e6, 16e6)
    contrast: Annotated[float, Interval(gt=0, le=1)] = 0.7
    electrons_at_1m: Positive = 100_000.0
    read_noise_e: NotNegative = 60.0
    full_well_e: Positive = 600_000.0
    ambient: NotNegative = 0.02
    min_amplitude_e: NotNegative = 300.0
    max_disagreement_m: Positive = 0.3
    supersampling: Annotated[int, Ge(1), IsOdd] = 3
    min_depth_m: Positive = 0.4
    max_depth_m: Positive = 6.0

    def __post_init__(self) -> None:
        assert self.min_depth_m < self.max_depth_m, "min_depth_m must be below max_depth_m"
        common = math.gcd(*(round(f) for f in self.frequencies_hz))
        assert self.frequencies_hz[0] <= 64 * common, "frequencies_hz without a common divisor"

    @property
    def margin_px(self) -> int:
        """A pixel."""
        return 1

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`. The lamp's light is rendered anyway, so shadow is explained."""
        window = shot.camera.rendered
        fine, other = self._render(shot)
        lamp_light = _pixel_mean(fine.radiance, self.supersampling)
        mean_e = self.electrons_at_1m * (lamp_light + other)
        path = self._path_m(window, fine.depth_m)

        buckets = np.stack(
            [self._expose(fine.radiance, path, f, mean_e, shot.rng) for f in self.frequencies_hz]
        )  # [F, 4, h, w]
        cosine_part = buckets[:, 0] - buckets[:, 2]
        sine_part = buckets[:, 1] - buckets[:, 3]
        amplitude = np.hypot(cosine_part, sine_part) / 2
        phase = np.arctan2(sine_part, cosine_part) % (2 * np.pi)
        half_path, disagreement = unwrapped(phase, amplitude, self.frequencies_hz)
        depth = self._depth(window, half_path)

        middle = (slice(self.supersampling // 2, None, self.supersampling),) * 2
        clean, label, cosine = (
            np.ascontiguousarray(a[middle]) for a in (fine.depth_m, fine.label, fine.cosine)
        )
        with np.errstate(invalid="ignore"):
            causes = {
                Reason.EMPTY: ~np.isfinite(clean),
                Reason.SHADOW: lamp_light <= 0,
                Reason.DARK: amplitude.min(axis=0) < self.min_amplitude_e,
                Reason.SATURATED: buckets.max(axis=(0, 1)) > self.full_well_e,
                Reason.INCONSISTENT: disagreement > self.max_disagreement_m,
                Reason.RANGE: ~((depth > self.min_depth_m) & (depth < self.max_depth_m)),
            }
        # A pixel on an edge is a measurement even where its centre sees nothing.
        dropped = np.any(list(causes.values())[2:], axis=0)
        reason = first_reason({Reason.OK: ~dropped, **causes}, Reason.UNMATCHED)
        pictures = {"left": _grey(amplitude[0]), "clean": clean}
        if shot.explain:
            pictures["lit"] = lamp_light > 0
        depth = np.where(dropped, np.nan, depth).astype(np.float32)
        return shot.frame(depth, reason, Image(lamp_light, clean, label, cosine), pictures)

    def _render(self, shot: Shot) -> tuple[Image, np.ndarray]:
        """The lamp's light in a camera with finer pixels, and radiance of other light [h, w]."""
        n, window, seed = self.supersampling, shot.camera.rendered, shot.seed()
        small = Intrinsics.centred(self.width_px * n, self.height_px * n, self.focal_px * n)
        part = Window(window.left * n, window.top * n, window.width * n, window.height * n)
        lamp = white_lamp(shot.pose_at(self.lamp_offset_m))
        camera = Camera(small, shot.camera.world_from_camera, part)
        lit = Scene(shot.bodies, lamp)
        (fine,) = shot.renderer.render(lit, [camera], seed=seed, geometry=[True])
        dim = shot.scene(None, self.ambient)
        if not dim.ambient and dim.area is None:
            return fine, np.zeros((window.height, window.width), dtype=np.float32)
        (other,) = shot.renderer.render(dim, [shot.camera], seed=seed, geometry=[False])
        return fine, other.radiance

    def _rays(self, window: Window, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Rays as x / z [1, w n] and y / z [h n, 1] of n by n places a pixel."""
        k = self.intrinsics
        u = window.left + (np.arange(window.width * n) - (n - 1) / 2) / n
        v = window.top + (np.arange(window.height * n) - (n - 1) / 2) / n
        return ((u - k.cx_px) / k.focal_px)[None], ((v - k.cy_px) / k.focal_px)[:, None]

    def _path_m(self, window: Window, depth_m: np.ndarray) -> np.ndarray:
        """Length of the way from lamp to surface to camera; 0 where nothing is."""
        x, y = self._rays(window, self.supersampling)
        z = np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float64)
        back = z * np.sqrt(1 + x * x + y * y)
        there = np.sqrt((z * x - self.lamp_offset_m) ** 2 + (z * y) ** 2 + z * z)
        return back + np.where(z > 0, there, 0)

    def _depth(self, window: Window, half_path_m: np.ndarray) -> np.ndarray:
        """Depth on the ray where there and back is twice `half_path_m`: an ellipse's equation."""
        x, y = self._rays(window, 1)
        length = np.sqrt(1 + x * x + y * y)
        path, offset = 2 * half_path_m, self.lamp_offset_m
        distance = (path**2 - offset**2) / (2 * np.maximum(path - offset * x / length, 1e-9))
        return distance / length

    def _expose(
        self,
        radiance: np.ndarray,
        path_m: np.ndarray,
        frequency_hz: float,
        mean_e: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """[4, h, w] electrons of one frequency, with noise."""
        phase = (2 * np.pi * frequency_hz / SPEED_OF_LIGHT) * path_m
        gain = self.electrons_at_1m * self.contrast
        real = gain * _pixel_mean(radiance * np.cos(phase), self.supersampling)
        imaginary = gain * _pixel_mean(radiance * np.sin(phase), self.supersampling)
        buckets = mean_e + np.stack([real, imaginary, -real, -imaginary])
        # The normal law stands in for Poisson's, as in InfraredCamera.
        sigma = np.sqrt(np.maximum(buckets, 0) + self.read_noise_e**2)
        return buckets + sigma * rng.standard_normal(buckets.shape)


def unwrapped(
    phase: np.ndarray,
    amplitude: np.ndarray,
    frequencies_hz: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """The distance on which all frequencies agree best.

    Every number of whole periods of the first frequency is tried; what the others then lack is
    weighed with 1 / sigma^2, which is proportional to (f A)^2 as the buckets' mean is common.
    `phase` in 0..2 pi and `amplitude` are [F, h, w].

    Returns:
        [h, w] half the path in metres, in 0..c / (2 gcd); [h, w] the largest difference of one
        frequency's distance from the result.
    """
    f = np.array(frequencies_hz)[:, None, None]
    period = SPEED_OF_LIGHT / (2 * f)
    distance = phase / (2 * np.pi) * period
    weight = (f * np.maximum(amplitude, 1e-6)) ** 2
    share = weight / weight.sum(axis=0)
    common = math.gcd(*(round(value) for value in frequencies_hz))
    best = np.full(phase.shape[1:], np.inf)
    found, worst = np.zeros_like(best), np.zeros_like(best)
    for turns in range(round(frequencies_hz[0] / common)):
        guess = distance[0] + turns * period[0]
        lack = (distance - guess + period / 2) % period - period / 2  # [F, h, w], first is 0
        shift = (share * lack).sum(axis=0)
        cost = (share * (lack - shift) ** 2).sum(axis=0)
        better = cost < best
        best = np.where(better, cost, best)
        found = np.where(better, guess + shift, found)
        worst = np.where(better, np.abs(lack - shift).max(axis=0), worst)
    return found % (SPEED_OF_LIGHT / (2 * common)), worst


def _pixel_mean(fine: np.ndarray, n: int) -> np.ndarray:
    """[h n, w n] -> [h, w] float64, the mean over each pixel's n by n places."""
    height, width = fine.shape[0] // n, fine.shape[1] // n
    return fine.reshape(height, n, width, n).mean(axis=(1, 3), dtype=np.float64)


def _grey(image: np.ndarray) -> np.ndarray:
    """A picture [h, w] uint8 for looking at: the 98 % quantile of what is lit at 220."""
    lit = image[image > 0]
    white = float(np.quantile(lit, 0.98)) if lit.size else 1.0
    return np.clip(np.rint(image * (220 / white)), 0, 255).astype(np.uint8)
