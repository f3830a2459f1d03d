"""A contact sheet: a row a class, one block of clouds a domain, all from one side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.geometry.orthographic import project
from qs3.utils.plotting import INK, SOFT, blank, cloud_colours, save_png

_PANEL, _LABEL, _GAP = 1.25, 1.0, 0.2  # inches


def sheet(
    path: Path,
    rows: Mapping[str, Sequence[Sequence[np.ndarray]]],
    titles: Sequence[str],
    heading: str,
) -> None:
    """Save a PNG; colour is the height, and what is farther away is paler.

    Args:
        path: of the PNG.
        rows: by class, for each block its clouds [P, 3], z up.
        titles: one a block, above it.
        heading: a line above all.
    """
    widths = [max(1, *(len(blocks[k]) for blocks in rows.values())) for k in range(len(titles))]
    lefts = [_LABEL + k * _GAP + sum(widths[:k]) * _PANEL for k in range(len(titles))]
    top = 0.62 if any(titles) else 0.4
    width, height = lefts[-1] + widths[-1] * _PANEL + 0.1, top + len(rows) * _PANEL + 0.1
    figure = blank(width, height, 110)
    # One pair of axes in inches for everything: hundreds of axes would take seconds.
    axes: Any = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    axes.text(width / 2, 0.2, heading, size=11, ha="center", va="center", color=INK)
    for left, many, title in zip(lefts, widths, titles, strict=True):
        middle = left + many * _PANEL / 2
        axes.text(middle, 0.47, title, size=9, ha="center", va="center", color=INK)
    for row, (cls, blocks) in enumerate(rows.items()):
        y = top + (row + 0.5) * _PANEL
        axes.text(0.08, y, cls, size=10, va="center", color=INK)
        for left, clouds in zip(lefts, blocks, strict=True):
            if not clouds:
                axes.text(left + _PANEL / 2, y, "none", size=8, ha="center", color=SOFT)
            for i, cloud in enumerate(clouds):
                seen, depth, up = project(cloud)
                place = (left + (i + 0.5) * _PANEL, y) + seen * _PANEL * (0.47, -0.47)
                size = float(np.clip(1800 / len(cloud), 0.8, 6.0))
                axes.scatter(*place.T, s=size, c=cloud_colours(up, depth), linewidths=0)
    save_png(figure, path)
