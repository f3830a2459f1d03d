"""The look of all figures, without pyplot: no screen is needed, and no figure stays open."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.utils.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, SOFT, GRID = "#1d2430", "#6b7482", "#e3e6eb"
PAPER, PANEL = "#ffffff", "#f7f8fa"
DARK = "#18141c"
"""Where nothing was measured."""
PALE = (0.93, 0.94, 0.96)
"""What the colours of a cloud fade to with distance."""
BLUE, ORANGE, GREEN, RED = "#2f6db3", "#d9822b", "#3a8f5c", "#b5403a"
PALE_BLUE = "#b9d0ea"


def blank(width: float, height: float, dpi: float, *, constrained: bool = False) -> Figure:
    """A figure without axes; sizes in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=PAPER)
    if constrained:
        figure.set_layout_engine("constrained")
    FigureCanvasAgg(figure)
    return figure


@contextlib.contextmanager
def boxes_for_letters() -> Iterator[None]:
    """Draw names with letters that no font here has; matplotlib warns of each of them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        yield


def save_png(figure: Figure, path: Path) -> None:
    """Save, atomically; the file names no program, so that it is the same with any version."""
    with boxes_for_letters(), atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})


def cloud_colours(height: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[P, 3] colours: by height [P] in 0..1, and paler by depth [P] from 0 (far) to 1 (near)."""
    from matplotlib import colormaps

    near = (0.35 + 0.65 * depth)[:, None]
    colours: np.ndarray = colormaps["viridis"](0.02 + 0.86 * height)[:, :3]
    return near * colours + (1 - near) * np.array(PALE)
