"""Whether frames are of a wall after all: what was measured, held against the fitted model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qs3.calibration.fit.noise import Noise
from qs3.calibration.fit.planes import PATCH_PX, Wall
from qs3.calibration.fit.steps import Steps
from qs3.errors import DataError

_MOST_TOGETHER = 0.4  # real Kinect frames of a table have 0.17 to 0.33
_LARGE = 0.01  # of the distance: such errors are a camera's only if neighbours err apart
_OFF = 2.0  # times the model's noise, in the middle of a frame's bins
_FAR_OFF = 3.0  # times, in any bin


def check_walls(walls: Sequence[Wall], noise: Noise, steps: Steps) -> list[str]:
    """A sentence for each frame that may not show a wall.

    A camera's noise follows its law in every frame, and errors far from each other in the image
    have nothing to do with each other once a smooth surface is taken off. Of a scene with things in
    it neither holds.

    Raises:
        DataError: frames that are surely none; all of them are named.
    """
    model = np.sqrt(noise.law_m(noise.depth_m) ** 2 + steps.rounding_m(noise.depth_m) ** 2)
    ratio = noise.sigma_m / model
    refused, doubted = [], []
    for index, wall in enumerate(walls):
        own = noise.frame == index
        together = 100 * noise.together[index]
        patches = (
            f"{together:.0f} % of the errors' variance is that of patches {PATCH_PX} px wide, "
            "where noise has little"
        )
        structured = noise.together[index] > _MOST_TOGETHER
        if own.any() and (np.median(ratio[own]) > _OFF or ratio[own].max() > _FAR_OFF):
            worst = int(np.flatnonzero(own)[np.argmax(ratio[own])])
            refused.append(
                f"{wall.name}: {1e3 * noise.sigma_m[own].min():.1f} to "
                f"{1e3 * noise.sigma_m[own].max():.1f} mm off a smooth surface; at "
                f"{noise.depth_m[worst]:.2f} m the law of all frames says {1e3 * model[worst]:.1f} "
                f"mm, where it has {1e3 * noise.sigma_m[worst]:.1f}"
            )
        elif structured and own.any() and _relative(noise, own) > _LARGE:
            size = 100 * _relative(noise, own)
            refused.append(f"{wall.name}: errors of {size:.1f} % of the distance; {patches}")
        elif structured:
            doubted.append(f"{wall.name}: {patches}: is it a flat wall, and nothing else?")
    if refused:
        raise DataError(
            "not of a flat wall:\n  "
            + "\n  ".join(refused)
            + "\nLeave these frames out, or take others of a flat, matt wall that fills the view"
        )
    return doubted


def _relative(noise: Noise, own: np.ndarray) -> float:
    return float(np.median(noise.sigma_m[own] / noise.depth_m[own]))
