"""The figure of the pipeline: what one object looks like at every stage, from images to residuals.

Images are of one view; clouds are all views together, drawn from the side of the camera, in metres
and to one scale. A stage that a sensor does not have says so in its place.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.generation.provenance import photograph
from qs3.generation.view_files import REASON_COLOURS, KeptView
from qs3.geometry.orthographic import axes_of, unit
from qs3.report.figures.pipeline import ScannedObject
from qs3.sensors.pixel_status import Reason
from qs3.utils.plotting import DARK, GRID, INK, PANEL, SOFT, blank, cloud_colours, save_png
from qs3.utils.plural import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 150
_ROW = 3.9  # inches
_UPRIGHT = 1.06  # a panel's height by its width: room for the bar of length below a cloud
_ASIDE_DEG = (
    40.0  # the clouds are seen from so far to the side of the camera, to show errors of depth
)
_BEFORE_BEHIND = ("#1f5fbf", "#b4bac3", "#c8321f")


def pipeline_figure(one: ScannedObject, view: int = 0) -> Figure:
    """Draw one object's pipeline; its images are those of a view.

    Raises:
        ConfigError: it has no such view.
    """
    shown = one.view(view)
    rows = 1 if shown is None else 2
    width, height = 12.0, _ROW * rows + 0.45  # inches
    figure = blank(width, height, _DPI)
    axes: Any = figure.subplots(
        rows,
        4,
        squeeze=False,
        gridspec_kw={
            "left": 0.015, "right": 0.985, "wspace": 0.08, "hspace": 0.42,
            "top": 1 - 0.85 / height, "bottom": 0.65 / height,
        },
    )  # fmt: skip
    words = f"{one.name}, {one.domain}"
    if shown is not None:
        by = f" rendered by {one.renderer.capitalize()}" if one.renderer else ""
        words += f": {one.sensor}{by}, {counted(len(one.views), 'view')}"
        draw_images(axes[0], shown)
        draw_reasons(axes[1, 0], shown)
    else:
        _say(
            axes[0, 0],
            "images, disparity, depth",
            "None: points were sampled\non the surface itself.\nNo sensor looked at it,\n"
            "so there is no noise,\nand nothing is hidden.",
        )
    draw_clouds(axes[-1, 1:], one)
    figure.suptitle(words, fontsize=12, color=INK, y=1 - 0.22 / height)
    return figure


def save_pipeline(one: ScannedObject, path: str | Path, view: int = 0) -> Path:
    """Write the figure as a PNG, atomically and without a date in it."""
    figure = pipeline_figure(one, view)
    save_png(figure, Path(path))
    return Path(path)


def draw_images(axes: Any, view: KeptView) -> None:
    """Both images, disparity and depth of a view, into four axes."""
    frame, images = view.frame, view.frame.images
    disparity = images.get("disparity")
    title = f"view {view.number}: {'infrared, left' if 'right' in images else 'infrared'}"
    seen = photograph(images)
    if seen is None:
        _say(axes[0], title, "none: this sensor's model\nmakes no picture")
    else:
        _picture(axes[0], title, seen)
    if "right" in images:
        _picture(axes[1], "infrared, right", images["right"])
    elif "reference" in images:
        _picture(axes[1], "stored picture of the pattern", images["reference"])
    else:
        why = "one camera and a projector" if disparity is not None else "one camera"
        _say(axes[1], "second image", f"none: this sensor has\n{why}")
    if disparity is None:
        _say(axes[2], "disparity", "none: this sensor\ndoes not triangulate")
    else:
        _values(axes[2], "disparity", disparity, "px")
    _values(axes[3], "depth as measured", frame.depth_m, "m", reverse=True)


def draw_reasons(ax: Any, view: KeptView) -> None:
    """Why each pixel of a view has a depth or none."""
    from matplotlib.patches import Patch

    reason = view.frame.reason
    picture = np.zeros((*reason.shape, 3))
    handles = []
    for kind, bgr in REASON_COLOURS.items():
        share = float((reason == kind).mean())
        rgb = (bgr[2] / 255, bgr[1] / 255, bgr[0] / 255)
        picture[reason == kind] = rgb
        if share >= 0.0005:
            words = f"{'measured' if kind == Reason.OK else kind.name.lower()} {share:.1%}"
            handles.append(Patch(color=rgb, label=words))
    ax.imshow(picture, interpolation="nearest")
    _frame(ax, "why there is a depth or none")
    ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2,
              fontsize=7.5, frameon=False, handlelength=1.0, labelcolor=INK)  # fmt: skip


def draw_clouds(axes: Any, one: ScannedObject) -> None:
    """The cloud, its clean twin and its residuals, into three axes to one scale."""
    turn = axes_of(*_side(one))
    corners = one.cloud.astype(np.float64)
    if one.clean is not None:
        corners = np.concatenate([corners, one.clean])
    if one.mesh is not None:
        corners = np.concatenate([corners, one.mesh.bounds])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = 1.04 * float(np.abs((corners - middle) @ turn[:2].T).max())
    bar = _round(0.6 * radius, (1, 2, 5), up=False)
    views = counted(len(one.views), "view", "views fused") if one.views else "surface samples"
    kinds = ((f"cloud: {views}", one.cloud), ("clean twin: true depth, same views", one.clean))
    for ax, (title, cloud) in zip(axes, kinds, strict=False):
        if cloud is None:
            _say(ax, "clean twin", "none: it is made from\nthe true depth of views")
            continue
        local, order = _turned(cloud, middle, turn)
        colours = cloud_colours(unit(cloud[:, 2].astype(np.float64))[order], unit(local[:, 2]))
        ax.scatter(*local[:, :2].T, s=_size(cloud), c=colours, linewidths=0)
        _room(ax, radius, bar)
        _frame(ax, f"{title}\n{len(cloud):,} points, colour is height")
    _draw_residuals(axes[2], one, middle, turn, radius, bar)


def _draw_residuals(
    ax: Any, one: ScannedObject, middle: np.ndarray, turn: np.ndarray, radius: float, bar: float
) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    if one.residual_m is None:
        why = textwrap.fill(one.why_no_mesh, 32)
        _say(ax, "residuals", f"none: the true surface is not\nknown:\n{why}")
        return
    residual = 1000 * one.residual_m  # mm
    size = np.abs(residual)
    median, most = np.percentile(size, [50, 95])
    limit = _round(max(float(most), 0.1), (1, 1.5, 2, 3, 4, 5, 6, 8, 10), up=True)
    local, order = _turned(one.cloud, middle, turn)
    colours = LinearSegmentedColormap.from_list("before and behind", _BEFORE_BEHIND)
    dots = ax.scatter(*local[:, :2].T, s=_size(one.cloud), c=residual[order], cmap=colours,
                      vmin=-limit, vmax=limit, linewidths=0)  # fmt: skip
    _room(ax, radius, bar)
    figures = f"half within {median:.1f} mm, 95 % within {most:.1f} mm"
    if most < 0.05:
        figures = "on the surface, but for rounding"
    _frame(ax, f"residuals: distance to the mesh\n{figures}")
    words = "mm (+ behind the surface, - before it)" if one.views else "mm"
    _bar(ax, dots, words, extend="both")


def _side(one: ScannedObject) -> tuple[float, float]:
    """Azimuth and elevation of whoever looks at the clouds, degrees."""
    if not one.views:
        return -55.0, 18.0
    away = -one.views[0].world_from_camera[:3, 2]  # from the object to the first camera
    return float(np.rad2deg(np.arctan2(away[1], away[0]))) + _ASIDE_DEG, 18.0


def _turned(cloud: np.ndarray, middle: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, ...]:
    """[P, 3] metres right, up and towards us, farthest first; and their order."""
    local = (cloud.astype(np.float64) - middle) @ turn.T
    order = np.argsort(local[:, 2], kind="stable")
    return local[order], order


def _size(cloud: np.ndarray) -> float:
    return float(np.clip(6000 / len(cloud), 1.2, 14.0))


def _room(ax: Any, radius: float, bar: float) -> None:
    """Limits in metres, and a bar that says how long so much is."""
    low = (1 - 2 * _UPRIGHT) * radius
    ax.set(xlim=(-radius, radius), ylim=(low, radius), aspect="equal")
    left, low = -0.96 * radius, low + 0.06 * radius
    ax.plot([left, left + bar], [low, low], color=INK, linewidth=2.2, solid_capstyle="butt")
    words = f"{100 * bar:g} cm" if bar < 1 else f"{bar:g} m"
    ax.text(left + bar + 0.03 * radius, low, words, fontsize=7.5, va="center", color=INK)


def _picture(ax: Any, title: str, image: np.ndarray) -> None:
    finite = np.where(np.isfinite(image), image, 0).astype(np.float64)
    lit = finite[finite > 0]
    high = float(np.percentile(lit, 99)) if len(lit) else 1.0
    # A gamma, as a screen has one: the surface between the dots would be black.
    ax.imshow((finite / high).clip(0, 1) ** 0.6, cmap="gray", vmin=0, vmax=1)
    _frame(ax, title)
    ax.set_xlabel(f"{image.shape[1]} x {image.shape[0]} px", fontsize=7.5, color=SOFT)


def _values(ax: Any, title: str, values: np.ndarray, unit_: str, reverse: bool = False) -> None:
    """An image of numbers, near is bright, with a bar; dark where there is none."""
    from matplotlib import colormaps

    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        _say(ax, title, "no pixel has one")
        return
    low, high = np.percentile(finite, [1, 99])
    colours = colormaps["viridis_r" if reverse else "viridis"].with_extremes(bad=DARK)
    shown = ax.imshow(np.ma.masked_invalid(values), cmap=colours, vmin=low, vmax=high,
                      interpolation="nearest")  # fmt: skip
    _frame(ax, title)
    _bar(ax, shown, unit_, extend="neither")


def _bar(ax: Any, drawn: Any, words: str, extend: str) -> None:
    place = ax.inset_axes((0.05, -0.055, 0.9, 0.03))
    bar = ax.figure.colorbar(drawn, cax=place, orientation="horizontal", extend=extend)
    bar.ax.tick_params(labelsize=7.5, color=SOFT)
    bar.ax.set_xlabel(words, fontsize=8, color=SOFT, labelpad=1)
    bar.outline.set_linewidth(0.4)


def _frame(ax: Any, title: str) -> None:
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=9, color=INK)
    for spine in ax.spines.values():
        spine.set(color=GRID, linewidth=0.6)


def _say(ax: Any, title: str, words: str) -> None:
    """Write instead of drawing."""
    _frame(ax, title)
    ax.set(facecolor=PANEL, xlim=(0, 1), ylim=(0, 1))
    ax.set_box_aspect(_UPRIGHT)
    ax.text(0.5, 0.5, words, ha="center", va="center", fontsize=9, color=SOFT)


def _round(value: float, steps: Sequence[float], up: bool) -> float:
    """The next step times a power of ten from `value` on, or the last one up to it."""
    power = 10.0 ** np.floor(np.log10(value))
    numbers = [float(step * power) for step in steps]
    if up:
        return min(number for number in numbers if number >= value * (1 - 1e-9))
    return max(number for number in numbers if number <= value * (1 + 1e-9))
