"""qs3: from CAD meshes to a classifier that works on real depth scans.

Implements QS3 (Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of
Object Point Clouds", ECCV 2022). Importing this package imports nothing heavy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from qs3.inference import Predictor

__version__ = "0.1.0"


def load(run: str | Path, **settings: Any) -> Predictor:
    """The classifier that a finished run reports; see `qs3.inference.load`."""
    from qs3.inference import load as load_result

    return load_result(run, **settings)
