"""qs3: from CAD meshes to a classifier that works on real depth scans.

Implements QS3 (Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of
Object Point Clouds", ECCV 2022). Importing this package imports nothing heavy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from qs3.utils.version import VERSION as __version__

if TYPE_CHECKING:
    from qs3.api import generate, train
    from qs3.generation.sense import match, sense
    from qs3.inference.predictor import load

__all__ = ["__version__", "generate", "load", "match", "sense", "train"]

_PLACES = {"generate": "api", "train": "api", "load": "inference.predictor"}


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(f"qs3.{_PLACES.get(name, 'generation.sense')}"), name)
    raise AttributeError(f"module 'qs3' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
