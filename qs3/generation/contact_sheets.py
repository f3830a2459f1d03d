"""What a finished dataset shows at a glance: clouds.png and infrared.png, some objects a class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.geometry.orthographic import project
from qs3.utils.plotting import DARK, INK, SOFT, blank, cloud_colours, save_png

OBJECTS = 4  # a class, in clouds.png
_PANEL, _LABEL, _TOP = 1.25, 1.0, 0.62  # inches
_SHOWN = (("infrared", "infrared", ""), ("disparity", "disparity", "px"), ("depth_m", "depth", "m"))

Arrays = Mapping[str, np.ndarray]


def clouds_picture(
    path: Path, clouds: Mapping[str, Sequence[Arrays]], heading: str, twin: bool
) -> None:
    """Save a row of clouds a class, each as measured and next to it from the true depth.

    All panels of a row have one scale, which its label states; colour is the height.

    Args:
        path: of the PNG.
        clouds: by class, some objects' arrays "points" and, with `twin`, "points_clean": [P, 3].
        heading: a line above all.
        twin: whether there are clean twins.
    """
    kinds = ("points", "points_clean") if twin else ("points",)
    columns = max(1, *(min(OBJECTS, len(some)) for some in clouds.values())) * len(kinds)
    width, height = _LABEL + columns * _PANEL + 0.1, _TOP + len(clouds) * _PANEL + 0.1
    figure = blank(width, height, 100)
    # One pair of axes in inches for everything: hundreds of axes would take seconds.
    axes: Any = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    axes.text(width / 2, 0.2, heading, size=11, ha="center", va="center", color=INK)
    for column in range(columns):
        title = "measured" if kinds[column % len(kinds)] == "points" else "clean twin"
        axes.text(_middle(column), 0.47, title, size=7.5, ha="center", va="center", color=SOFT)
    places, colours = [], []
    for row, (cls, objects) in enumerate(clouds.items()):
        middle = _TOP + (row + 0.5) * _PANEL
        extent = max((_extent(cloud[kind]) for cloud in objects for kind in kinds), default=1.0)
        axes.text(0.08, middle - 0.08, cls, size=10, va="center", color=INK)
        label = f"panel {extent:.2g} m" if objects else "none"
        axes.text(0.08, middle + 0.12, label, size=7, va="center", color=SOFT)
        for i, cloud in enumerate(objects[:OBJECTS]):
            for j, kind in enumerate(kinds):
                seen, colour = _drawn(cloud[kind])
                scale = 0.94 * _PANEL / extent
                centre = (_middle(i * len(kinds) + j), middle)
                places.append(centre + seen * (scale, -scale))
                colours.append(colour)
    if places:
        axes.scatter(*np.concatenate(places).T, s=0.8, c=np.concatenate(colours), linewidths=0)
    save_png(figure, path)


def infrared_picture(path: Path, previews: Mapping[str, tuple[str, Arrays]], heading: str) -> None:
    """Save one view a class: what the camera saw, the disparity, the depth.

    Args:
        path: of the PNG.
        previews: by class, an object's id and its pictures (qs3.generation.provenance.preview_of).
        heading: a line above all.
    """
    panel, label, caption, gap = 1.7, 0.3, 0.2, 0.25
    blocks = 2 if len(previews) > 3 else 1
    rows = -(-len(previews) // blocks)
    block, step = 3 * panel + gap, label + panel + caption
    width, height = blocks * block + 0.1, 0.45 + rows * step + 0.1
    figure = blank(width, height, 110)

    def write(x: float, y: float, text: str, size: float, color: str, align: str = "left") -> None:
        place: dict[str, Any] = {"ha": align, "va": "center"}
        figure.text(x / width, y / height, text, size=size, color=color, **place)

    write(width / 2, height - 0.2, heading, 11, INK, "center")
    for number, (cls, (name, pictures)) in enumerate(previews.items()):
        x = 0.1 + number // rows * block
        bottom = height - 0.45 - number % rows * step - label - panel
        write(x, bottom + panel + 0.13, cls, 10, INK)
        write(x + 3 * panel - 0.08, bottom + panel + 0.13, name, 6.5, SOFT, "right")
        for column, (kind, title, unit) in enumerate(_SHOWN):
            left = x + column * panel
            box = (left / width, bottom / height, (panel - 0.08) / width, panel / height)
            axes: Any = figure.add_axes(box, xticks=[], yticks=[], facecolor=DARK)
            text = title + _show(axes, pictures.get(kind), unit)
            write(left + (panel - 0.08) / 2, bottom - 0.09, text, 6.5, SOFT, "center")
    save_png(figure, path)


def _show(axes: Any, image: np.ndarray | None, unit: str) -> str:
    """Draw an image with invalid pixels dark; returns its range as text."""
    from matplotlib import colormaps

    if image is None or not np.isfinite(image).any():
        return ": none"
    values = np.ma.masked_invalid(image)
    low, high = _range(values.compressed())
    name, low = ("viridis", low) if unit else ("gray", 0.0)
    colours = colormaps[name].with_extremes(bad=DARK)
    axes.imshow(values, cmap=colours, vmin=low, vmax=high)
    return f" {low:.2f} to {high:.2f} {unit}" if unit else ""


def _range(values: np.ndarray) -> tuple[float, float]:
    """From where to where an image is told apart: the object's range, whatever is stray.

    The shortest interval that four fifths of the pixels lie in, and half as much more on either
    side, within the middle 98 %.
    """
    values = np.sort(values)
    within = -(-4 * len(values) // 5)
    wide = values[within - 1 :] - values[: len(values) - within + 1]
    begin = int(wide.argmin())
    low, high = np.percentile(values, [1, 99])
    more = wide[begin] / 2
    return max(low, values[begin] - more), min(high, values[begin + within - 1] + more)


def _middle(column: int) -> float:
    return _LABEL + (column + 0.5) * _PANEL


def _extent(cloud: np.ndarray) -> float:
    """Diameter of the ball that `project` makes a unit ball of."""
    middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    return max(2 * float(np.linalg.norm(cloud - middle, axis=1).max()), 1e-9)


def _drawn(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[P, 2] right and up in metres, farthest first, and [P, 3] colours."""
    seen, depth, height = project(cloud)
    return seen * _extent(cloud) / 2, cloud_colours(height, depth)
