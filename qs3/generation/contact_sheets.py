"""What a finished dataset shows at a glance: clouds.png and infrared.png, some objects a class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from qs3.utils.pictures import cloud_image, save_png, sheet, value_image

OBJECTS = 4  # a class, in clouds.png
_KINDS = {"points": "measured", "points_clean": "clean twin"}
_IMAGES = {"infrared": ("infrared", "gray", ""), "disparity": ("disparity", "viridis", "px"),
           "depth_m": ("depth", "viridis", "m")}  # fmt: skip

Arrays = Mapping[str, np.ndarray]


def clouds_picture(
    path: Path, clouds: Mapping[str, Sequence[Arrays]], heading: str, twin: bool
) -> None:
    """Save a row of clouds a class, each as measured and next to it from the true depth.

    Args:
        path: of the PNG.
        clouds: by class, some objects' arrays "points" and, with `twin`, "points_clean": [P, 3].
        heading: a line above all.
        twin: whether there are clean twins.
    """
    kinds = list(_KINDS)[: 1 + twin]
    shown = [some[i][kind] if i < len(some) else None
             for some in clouds.values() for i in range(OBJECTS) for kind in kinds]  # fmt: skip
    figure = sheet(
        [None if cloud is None else cloud_image(cloud, 320) for cloud in shown],
        ["" if cloud is None else f"{np.ptp(cloud, axis=0).max():.2g} m" for cloud in shown],
        columns=OBJECTS * len(kinds),
        heading=heading,
        rows=list(clouds),
        heads=[_KINDS[kind] for kind in kinds] * OBJECTS,
        panel_in=1.25,
    )
    save_png(figure, path, colours=256)


def infrared_picture(path: Path, previews: Mapping[str, tuple[str, Arrays]], heading: str) -> None:
    """Save one view a class: what the camera saw, the disparity, the depth.

    Args:
        path: of the PNG.
        previews: by class, an object's id and its pictures (qs3.generation.provenance.preview_of).
        heading: a line above all.
    """
    images, titles = [], []
    for cls, (_, pictures) in previews.items():
        for kind, (name, colours, unit) in _IMAGES.items():
            values = np.asarray(pictures.get(kind, np.full((3, 4), np.nan)), dtype=np.float64)
            low, high = shown_range(values)
            images.append(value_image(values, low if unit else 0.0, high, colours))
            words = f" {low:.2f} to {high:.2f} {unit}" if unit and high > low else ""
            titles.append(f"{cls}: {name}{words}")
    save_png(sheet(images, titles, columns=6, heading=heading, panel_in=1.7), path, colours=256)


def shown_range(image: np.ndarray) -> tuple[float, float]:
    """From where to where an image is told apart: the object's range, whatever is stray.

    The shortest interval that four fifths of the finite pixels lie in, and half as much more on
    either side, within the middle 98 %.
    """
    values = np.sort(image[np.isfinite(image)])
    if not len(values):
        return 0.0, 0.0
    within = -(-4 * len(values) // 5)
    wide = values[within - 1 :] - values[: len(values) - within + 1]
    begin = int(wide.argmin())
    low, high = np.percentile(values, [1, 99])
    more = wide[begin] / 2
    return max(low, values[begin] - more), min(high, values[begin + within - 1] + more)
