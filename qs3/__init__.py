"""qs3: from CAD meshes to a classifier that works on real depth scans.

Implements QS3 (Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of
Object Point Clouds", ECCV 2022). Importing this package imports nothing heavy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import torch

    from qs3.inference.predictor import Predictor

__version__ = "0.1.0"


def load(
    run: str | Path,
    *,
    device: str | torch.device = "cpu",
    packages: Sequence[str] = ("qs3.models",),
) -> Predictor:
    """The classifier that a finished run reports.

        predictor = qs3.load("logs/qs3_s2d/seed0-1a2b3c4d")
        probabilities = predictor([cloud_a, cloud_b])  # [2, classes] float64
        predictor.classes  # their names, in that order

    A cloud is an [n, 3] array of x y z with any n, any size and place, z up (or `up=`).

    Args:
        run: its folder, or the file result.pt of it, which needs nothing beside it.
        device: where to run it: "cpu", "cuda", "cuda:1".
        packages: where the net of the file may be defined. For a net of your own add your
            package, if you trust it to be built with any arguments.

    Returns:
        See `qs3.inference.predictor.Predictor`.

    Raises:
        qs3.errors.MissingDataError: no finished run there.
        qs3.errors.DataError: the file is damaged, or asks for something else than a net of
            `packages`.
        qs3.errors.ConfigError: no such device.
    """
    from qs3.inference.predictor import load as load_result  # imports torch: only when it is needed

    return load_result(run, device=device, packages=packages)
