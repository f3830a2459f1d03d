"""Sinusoidal fringes: slides, and from exposures back to the place on the slide.

N-step phase shifting with temporal unwrapping: slide n of P periods shows

    (1 + cos(2 pi P s + 2 pi n / N)) / 2,        0 <= s <= 1 across the slide,

and a pixel sees I_n = a + M cos(phase + 2 pi n / N). The phase follows from the discrete Fourier
sums of the I_n, whatever a (ambient light) and M (albedo, distance, blur) are; it is known up to
whole periods, which the next coarser fringes tell (Huntley and Saldner, Applied Optics 32(17),
1993). With noise of standard deviation sigma_n in each I_n, independent,

    sigma_phase = sqrt(2 / N) sigma_n / M,        sigma_s = sigma_phase / (2 pi P)

of the finest fringes. It holds with the mean variance where the noise depends on the signal, for
N >= 4 (shot noise is proportional to I_n, and the sum of cos sin^2 over the steps vanishes).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Ge

from qs3.utils.settings import Positive, settings

_COLUMNS_A_PERIOD = 8


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
        assert self.periods[-1] * _COLUMNS_A_PERIOD <= self.columns, (
            "a period needs 8 px of the slide"
        )

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
        phase, modulation = phase_of(exposures)
        turns = phase[0] / (2 * np.pi) % 1  # periods of the first fringes, counted from s = 0
        worst = np.zeros_like(turns)
        for level in range(1, len(self.periods)):
            fraction = phase[level] / (2 * np.pi)
            expected = turns * (self.periods[level] / self.periods[level - 1])
            whole = np.rint(expected - fraction)
            turns = whole + fraction
            worst = np.maximum(worst, np.abs(expected - turns))
        return turns / self.periods[-1], modulation, worst

    def place_sigma(
        self, noise: float | np.ndarray, modulation: float | np.ndarray
    ) -> float | np.ndarray:
        """Standard deviation of s, by the law of the module's docstring.

        `noise` is sigma_n of one exposure, root of the mean variance over the steps, and
        `modulation` M of the finest fringes, in the same units.
        """
        phase = math.sqrt(2 / self.steps) * noise / modulation
        return phase / (2 * np.pi * self.periods[-1])


def phase_of(exposures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phase in -pi..pi and modulation [..., h, w] of N equal steps [..., N, h, w]."""
    steps = exposures.shape[-3]
    angle = (2 * np.pi / steps) * np.arange(steps)
    real = np.einsum("n,...nhw->...hw", np.cos(angle), exposures, optimize=False)
    imaginary = -np.einsum("n,...nhw->...hw", np.sin(angle), exposures, optimize=False)
    return np.arctan2(imaginary, real), np.hypot(real, imaginary) * (2 / steps)
