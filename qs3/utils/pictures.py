"""Pictures: one look for all figures, clouds and values as images, and sheets of them.

Nothing is global (no pyplot): no screen is needed, and no figure stays open.
"""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from qs3.utils.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = UInt8[np.ndarray, "h w 3"]

INK, SOFT, GRID = "#1d2430", "#6b7482", "#e3e6eb"
PAPER, PANEL = "#ffffff", "#f7f8fa"
DARK = "#18141c"
"""Where nothing was measured."""
PALE = (0.93, 0.94, 0.96)
"""What the colours of a cloud fade to with distance."""
BLUE, ORANGE, GREEN, RED = "#2f6db3", "#d9822b", "#3a8f5c", "#b5403a"

AZIMUTH_DEG, ELEVATION_DEG = -55.0, 18.0
_BESIDE_DEG = 20.0  # of the camera: straight from there a scan looks whole
_THUMBNAIL_PX, _DOT_PX = 168, (2, 5)
_DPI = 130


def axes_of(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """Rows right, up and towards the viewer, who stands at this azimuth; z is up."""
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def unit(values: np.ndarray) -> np.ndarray:
    """The values stretched to 0..1; all 0 if they are equal."""
    return (values - values.min()) / max(float(np.ptp(values)), 1e-12)


def turn_deg(cloud: Float[np.ndarray, "p 3"]) -> float:
    """Degrees to turn the viewer by: what lies next to the origin is first seen from there.

    That is where a scan has its camera; what lies around the origin is seen as in all pictures.
    """
    low, size = cloud.min(axis=0), np.ptp(cloud, axis=0)
    middle = (low + size / 2)[:2]
    if np.linalg.norm(middle) <= np.linalg.norm(size[:2]) / 2:
        return 0.0
    return round(float(np.rad2deg(np.arctan2(*-middle[::-1]))) - _BESIDE_DEG - AZIMUTH_DEG, 1)


def cloud_colours(height: np.ndarray, depth: np.ndarray) -> Float[np.ndarray, "p 3"]:
    """Colours by height [P] in 0..1, paler by depth [P] from 0 (far) to 1 (near)."""
    from matplotlib import colormaps

    near = (0.35 + 0.65 * depth)[:, None]
    colours: np.ndarray = colormaps["viridis"](0.02 + 0.86 * height)[:, :3]
    return near * colours + (1 - near) * np.array(PALE)


def cloud_image(
    cloud: Float[np.ndarray, "p 3"],
    side_px: int = _THUMBNAIL_PX,
    azimuth_deg: float = AZIMUTH_DEG,
    colours: Float[np.ndarray, "p 3"] | None = None,
) -> Image:
    """A cloud, z up, seen without perspective from slightly above, scaled to fill the image.

    `colours` lie in 0..1; without them colour is height, and paler is farther.
    """
    xyz = np.asarray(cloud, dtype=np.float64)
    xyz = xyz - (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    xyz = xyz / max(float(np.linalg.norm(xyz, axis=1).max()), 1e-12)
    local = xyz @ axes_of(azimuth_deg, ELEVATION_DEG).T
    order = np.argsort(local[:, 2], kind="stable")  # the nearest come last, and stay
    if colours is None:
        colours = cloud_colours(unit(xyz[:, 2]), unit(local[:, 2]))
    painted = np.rint(255 * colours[order]).astype(np.uint8)
    times = side_px / _THUMBNAIL_PX
    dot = round(float(np.clip(60 / np.sqrt(len(xyz)), *_DOT_PX)) * times)
    half = (side_px - dot) / 2
    column = np.rint(half * (1 + local[order, 0])).astype(int)
    row = np.rint(half * (1 - local[order, 1])).astype(int)
    image = np.full((side_px, side_px, 3), _rgb(PANEL), dtype=np.uint8)
    for dv, du in np.ndindex(dot, dot):
        if np.hypot(dv - (dot - 1) / 2, du - (dot - 1) / 2) <= dot / 2:
            image[row + dv, column + du] = painted
    return image


def value_image(values: Float[np.ndarray, "h w"], low: float, high: float, colours: str) -> Image:
    """Values from low to high in a colour map of matplotlib; dark where they are not finite."""
    from matplotlib import colormaps

    share = (np.nan_to_num(values) - low) / max(high - low, 1e-12)
    image = np.rint(255 * colormaps[colours](share.clip(0, 1))[..., :3]).astype(np.uint8)
    image[~np.isfinite(values)] = _rgb(DARK)
    return image


def sheet(
    images: Sequence[Image | None],
    titles: Sequence[str],
    *,
    columns: int,
    heading: str = "",
    rows: Sequence[str] = (),
    heads: Sequence[str] = (),
    panel_in: float = 1.45,
) -> Figure:
    """A figure of images in rows and columns, scaled to squares of one size.

    Args:
        images: row by row; None leaves a place empty.
        titles: one below each image.
        columns: images in a row.
        heading: a line above all.
        rows, heads: what stands before each row and above each column.
        panel_in: side of a square, inches.
    """
    columns = min(columns, len(images))
    count = -(-len(images) // columns)
    wide, high = columns * panel_in + bool(rows), count * (panel_in + 0.3) + 0.4 * bool(heading)
    figure = blank(wide, high, _DPI, constrained=True)
    figure.suptitle(heading, fontsize=11, color=INK, weight="bold", parse_math=False)
    small: dict[str, Any] = {"fontsize": 7 if panel_in < 2 else 9, "color": SOFT}
    for i, axes in enumerate(figure.subplots(count, columns, squeeze=False).flat):
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        if i < len(images) and (image := images[i]) is not None:
            axes.imshow(image)
        else:
            axes.set(facecolor=PAPER, aspect="equal")
        axes.set_xlabel(titles[i] if i < len(titles) else "", parse_math=False, **small)
        if i % columns == 0 and i // columns < len(rows):
            axes.set_ylabel(rows[i // columns], fontsize=9, color=INK, rotation=0, ha="right")
        if i < min(columns, len(heads)):
            words = textwrap.fill(heads[i], round(18 * panel_in))
            axes.set_title(words, fontsize=8, color=INK, parse_math=False)
    return figure


def blank(width: float, height: float, dpi: float, *, constrained: bool = False) -> Figure:
    """A figure without axes; sizes in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=PAPER)
    if constrained:
        figure.set_layout_engine("constrained")
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Figure, path: Path, colours: int = 0) -> None:
    """Save, atomically and without a date or a program's name; 0: in all colours."""
    with warnings.catch_warnings():  # letters that no font here has are drawn as boxes
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        figure.canvas.draw()
    seen = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    with atomic_path(path) as temporary:
        temporary.write_bytes(png(seen, colours))


def png(image: Image, colours: int = 64) -> bytes:
    """An image as PNG; few colours are a third of the bytes, 0 keeps them all."""
    from PIL import Image as Pillow

    file = io.BytesIO()
    picture = Pillow.fromarray(np.ascontiguousarray(image))
    (picture.quantize(colours) if colours else picture).save(file, format="png", optimize=True)
    return file.getvalue()


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))
