"""A sheet a class: many of its clouds on one picture, to look for what does not belong there."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.geometry.orthographic import project
from qs3.report.contact_sheets import drawn, short
from qs3.report.inspection.open_dataset import Opened
from qs3.report.viewer.page import turn_deg
from qs3.utils.files import make_folder
from qs3.utils.plotting import INK, SOFT, blank, cloud_colours, save_png

OBJECTS = 48
"""Of a class, on its sheet, unless somebody says how many."""

_COLUMNS, _POINTS = 8, 600  # more points of a cloud say nothing at this size
_PANEL, _TITLE, _TOP = 1.3, 0.26, 0.5  # inches


def class_sheets(
    opened: Opened,
    folder: Path,
    *,
    split: str,
    most: int = OBJECTS,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> list[Path]:
    """Save FOLDER/CLASS.png of each class that a split has; of unlabelled data all.png.

    Below each cloud stand the end of its id, its tier if it has one, and its longest side where
    the dataset is in metres. What lies beside the origin is seen from there, a little from the
    side: that is where a single view has its camera.

    Args:
        opened: the dataset.
        folder: is made.
        split: whose clouds; those of other splits are not looked at.
        most: clouds of a class; of more these are drawn at random.
        seed: of that.
        advance: is called after each sheet.
    """
    data, kept = opened.data, opened.kept
    here = data.indices(split)
    labels = data.labels[here]
    classes = {data.classes[k]: here[labels == k] for k in range(len(data.classes))}
    members = {cls: own for cls, own in classes.items() if len(own)} or {"all": here}
    saved = []
    for cls, name in zip(members, file_names(list(members)), strict=True):
        positions = drawn(members[cls], most, seed)
        titles = []
        clouds = [np.asarray(data.points[i], dtype=np.float64) for i in positions]
        for i, cloud in zip(positions, clouds, strict=True):
            side = f"{np.ptp(cloud, axis=0).max():.2f} m" if opened.unit == "m" else ""
            words = ", ".join(filter(None, (kept[i].more.get("tier", ""), side)))
            titles.append(f"{short(data.ids[i])}\n{words}")
        count = f"{len(positions)} of {len(members[cls])}"
        heading = f"{cls}: {count} of {opened.label}, {split}"
        saved.append(_sheet(clouds, titles, make_folder(folder) / f"{name}.png", heading))
        advance()
    return saved


def file_names(classes: Sequence[str]) -> list[str]:
    """One a class, all different: its own where that can be a file's name on any system."""
    found: list[str] = []
    for cls in classes:
        name = re.sub(r"[^\w-]+", "_", cls)[:60] or "_"
        taken = {one.lower() for one in found}
        more = (f"{name}_{i}" for i in range(2, len(classes) + 2))
        found.append(next(n for n in (name, *more) if n.lower() not in taken))
    return found


def _sheet(clouds: Sequence[np.ndarray], titles: Sequence[str], path: Path, heading: str) -> Path:
    """Save one PNG, row by row."""
    columns = min(_COLUMNS, len(clouds))
    step = _PANEL + _TITLE
    width = max(columns, 4) * _PANEL + 0.1
    height = _TOP + -(-len(clouds) // columns) * step + 0.1
    figure = blank(width, height, 110)
    # One pair of axes in inches for everything: hundreds of axes would take seconds.
    axes: Any = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    axes.text(width / 2, 0.24, heading, size=11, ha="center", va="center", color=INK)
    places, colours = [], []
    for i, (cloud, title) in enumerate(zip(clouds, titles, strict=True)):
        row, column = divmod(i, columns)
        x, y = 0.05 + (column + 0.5) * _PANEL, _TOP + row * step + _PANEL / 2
        seen, colour = _seen(cloud)
        places.append((x, y) + seen * (0.47 * _PANEL, -0.47 * _PANEL))
        colours.append(colour)
        top = y + _PANEL / 2
        axes.text(x, top, title, size=6, ha="center", va="top", color=SOFT, parse_math=False)
    axes.scatter(*np.concatenate(places).T, s=1.6, c=np.concatenate(colours), linewidths=0)
    save_png(figure, path)
    return path


def _seen(cloud: Float[np.ndarray, "p 3"]) -> tuple[np.ndarray, np.ndarray]:
    """[n, 2] right and up within the unit disc, farthest first, and [n, 3] colours."""
    low, size = cloud.min(axis=0), np.ptp(cloud, axis=0)
    angle = -np.deg2rad(turn_deg(low, size))
    if len(cloud) > _POINTS:
        cloud = cloud[np.random.default_rng(0).choice(len(cloud), _POINTS, replace=False)]
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    seen, depth, height = project(np.column_stack([cloud[:, :2] @ turn, cloud[:, 2]]))
    return seen, cloud_colours(height, depth)
