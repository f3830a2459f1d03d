"""What the figures of a run are drawn with: one look for all, without pyplot.

Nothing is global: no screen is needed, and no figure stays open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qs3.utils.plotting import GRID, INK, SOFT, blank

_DPI = 130


class NothingToDrawError(Exception):
    """A figure has nothing to show; the message says why, for people."""


def new_figure(
    width: float,
    height: float,
    rows: int,
    columns: int,
    *,
    sharex: bool = False,
    heights: Sequence[float] | None = None,
) -> tuple[Any, list[Any]]:
    """A figure with its axes in row order; sizes in inches."""
    figure = blank(width, height, _DPI, constrained=True)
    grid: Any = figure.subplots(
        rows, columns, squeeze=False, sharex=sharex, gridspec_kw={"height_ratios": heights}
    )
    axes = list(grid.flat)
    for ax in axes:
        ax.tick_params(labelsize=9, color=GRID)
        ax.set_axisbelow(True)
        for side, spine in ax.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(GRID)
    return figure, axes


def curve(ax: Any, x: np.ndarray, y: np.ndarray, colour: str, label: str) -> None:
    """A line through the values that are there; dots if they are few."""
    there = np.isfinite(y)
    style = ".-" if there.sum() <= 60 else "-"
    ax.plot(x[there], y[there], style, color=colour, label=label, linewidth=1.3, markersize=4)
    ax.grid(axis="y", color=GRID, linewidth=0.7)


def cells(
    ax: Any, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], vmax: float
) -> Any:
    """A table of coloured cells with its names."""
    image = ax.imshow(values, cmap="Blues", vmin=0, vmax=vmax, aspect="auto")
    long = any(len(name) > 3 for name in columns)
    small = 9 if len(rows) <= 20 else 7
    ax.set_xticks(range(len(columns)), columns, fontsize=small, rotation=40 if long else 0,
                  ha="right" if long else "center")  # fmt: skip
    ax.set_yticks(range(len(rows)), rows, fontsize=small)
    return image


def cell_text(ax: Any, x: int, y: int, words: str, shade: float, size: float) -> None:
    """Write into a cell; `shade` is how dark it is, 0 to 1."""
    ax.text(x, y, words, ha="center", va="center", fontsize=size,
            color="white" if shade > 0.55 else INK)  # fmt: skip


def say(ax: Any, words: str) -> None:
    """Write instead of drawing."""
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=SOFT)
    ax.set(xticks=[], yticks=[])


def grouped_bars(
    ax: Any, names: Sequence[str], groups: Mapping[str, np.ndarray], colours: Sequence[str]
) -> None:
    """How many clouds each name has: a bar of each of `groups`, with its count if there is room."""
    place, wide = np.arange(len(names)), 0.8 / len(groups)
    for i, (label, counts) in enumerate(groups.items()):
        at = place + (i - (len(groups) - 1) / 2) * wide
        bars = ax.bar(at, counts, wide, label=label, color=colours[i])
        if len(names) <= 20:
            ax.bar_label(bars, fmt="{:,.0f}", fontsize=7, color=SOFT, padding=1)
    turn = 0 if len(names) <= 6 else 30 if len(names) <= 20 else 60
    ax.set_xticks(place, names, fontsize=9, rotation=turn, ha="right" if turn else "center")
    ax.set_ylabel("clouds", fontsize=9, color=SOFT)
    ax.margins(x=0.01, y=0.14)
    ax.grid(axis="y", color=GRID, linewidth=0.7)
    ax.legend(fontsize=8.5, frameon=False, ncols=len(groups), loc="lower right",
              bbox_to_anchor=(1.0, 0.99))  # fmt: skip
