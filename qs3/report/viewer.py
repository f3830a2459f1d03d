"""Clouds for the viewer of the pages: coordinates of 16 bits of the cloud's longest side.

A page of 50 clouds of 2,048 points has less than a megabyte. Names are data in the page, never
HTML.
"""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import DataError
from qs3.utils.page import render
from qs3.utils.pictures import AZIMUTH_DEG, ELEVATION_DEG, turn_deg

_USUAL = 50 * 2048  # points of a page, if points= is not given
_USUAL_CLOUD = 50_000  # and of one cloud
_NONE = 255  # of a residual
_RESIDUAL_SHARE = 0.9  # of residuals, that the colours tell apart
_LEVELS = 65535


@dataclass(frozen=True, eq=False)
class Shown:
    """A cloud on the page, and what is known of it.

    Attributes:
        name: anything.
        points: [n, 3] finite, z up, n >= 1.
        label: its class; "" if it is not known.
        called: the class that a net predicts; "" without a net.
        sure: with which confidence, in [0, 1]; None likewise.
        note: more to show below it.
        of: points that it had, if it was thinned before; 0: all are here.
        view: [n] which view saw each point, from 0; None if not known.
        residual: [n] distance of each point from where it should be; NaN where not known.
    """

    name: str
    points: Float[np.ndarray, "n 3"]
    label: str = ""
    called: str = ""
    sure: float | None = None
    note: str = ""
    of: int = 0
    view: Int[np.ndarray, " n"] | None = None
    residual: Float[np.ndarray, " n"] | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """Clouds that came together.

    Attributes:
        shown: in order.
        about: what they are and how many there were, in a line.
        unit: of their coordinates, such as "m"; "" if it is not known.
        residual_of: what residuals are distances to.
        failed: what could not be read, each with its reason.
    """

    shown: Sequence[Shown]
    about: str
    unit: str = ""
    residual_of: str = ""
    failed: Sequence[str] = ()


def points_each(clouds: int, asked: int | None) -> int:
    """How many points each of so many clouds has: `asked`, else what keeps a page small."""
    return asked or min(_USUAL // max(clouds, 1), _USUAL_CLOUD)


def thinned(one: Shown, most: int) -> Shown:
    """The cloud with at most so many of its points, drawn at random, always the same ones."""
    count = len(one.points)
    if count <= most:
        return one
    kept = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
    return dataclasses.replace(
        one,
        points=one.points[kept],
        of=one.of or count,
        view=None if one.view is None else one.view[kept],
        residual=None if one.residual is None else one.residual[kept],
    )


def viewer(parts: Sequence[Part], colour: str = "", points: int | None = None) -> dict[str, Any]:
    """What the viewer's template takes: "about" and "notes", lines each, and "data".

    Args:
        parts: of clouds, in order.
        colour: which comes first of height, view, residual, class and confidence, if it is known.
        points: of each cloud, at most; None: what keeps the page below a megabyte or so.

    Raises:
        DataError: no clouds.
    """
    whole = [one for part in parts for one in part.shown]
    failed = [words for part in parts for words in part.failed]
    if not whole:
        raise DataError("\n".join(["there is no cloud to show", *failed]))
    most = points_each(len(whole), points)
    shown = [thinned(one, most) for one in whole]
    units = {part.unit for part in parts}
    about = [part.about for part in parts]
    if any(len(one.points) > most for one in whole):
        about.append(f"at most {most} points of a cloud are shown (points=)")
    data = _data(shown, colour) | {
        "unit": units.pop() if len(units) == 1 else "",
        "residual_of": "; ".join(dict.fromkeys(p.residual_of for p in parts if p.residual_of)),
    }
    return {"about": about, "notes": [f"not read: {words}" for words in failed], "data": data}


def page(title: str, parts: Sequence[Part], colour: str = "", points: int | None = None) -> str:
    """A page of clouds as HTML; see `viewer`."""
    return render("clouds.html", title=title, **viewer(parts, colour, points))


def _data(shown: Sequence[Shown], colour: str) -> dict[str, Any]:
    from matplotlib import colormaps

    known = [one.residual[np.isfinite(one.residual)] for one in shown if one.residual is not None]
    residuals = np.concatenate([*known, np.empty(0)])
    most = _nice(float(np.quantile(residuals, _RESIDUAL_SHARE))) if len(residuals) else 1.0
    classes = sorted({name for one in shown for name in (one.label or one.called,) if name})
    views = sorted({int(k) for one in shown if one.view is not None for k in np.unique(one.view)})
    sure = [one for one in shown if one.sure is not None]
    known_of = {"height": True, "view": views, "residual": known, "class": classes,
                "confidence": sure}  # fmt: skip
    modes = [mode for mode, there in known_of.items() if there]
    return {
        "clouds": [_cloud(one, most) for one in shown],
        "start": {"azimuth": AZIMUTH_DEG, "elevation": ELEVATION_DEG},
        "modes": modes,
        "colour": colour if colour in modes else modes[0],
        "residual_most": f"{most:g}",
        "classes": classes,
        "views": views,
        "ramp": _bytes(colormaps["viridis"](np.linspace(0, 1, 16))),
        "class_colours": _distinct(len(classes)),
        "view_colours": _distinct(max(views, default=0) + 1),
    }


def _cloud(one: Shown, most: float) -> dict[str, Any]:
    xyz = np.asarray(one.points, dtype=np.float64)
    low, size = xyz.min(axis=0), np.ptp(xyz, axis=0)
    step = float(size.max()) / _LEVELS or 1.0
    found: dict[str, Any] = {
        **{key: getattr(one, key) for key in ("name", "label", "called", "sure", "note", "of")},
        "count": len(xyz),
        "size": [float(f"{side:.6g}") for side in size],
        "radius": float(np.linalg.norm(xyz - low - size / 2, axis=1).max()) or 1.0,
        "step": step,
        "turn": turn_deg(xyz),
        "xyz": _base64(np.rint((xyz - low) / step).astype("<u2")),
    }
    if one.view is not None:
        found["view"] = _base64(np.minimum(one.view, 255).astype(np.uint8))
    if one.residual is not None:
        share = np.nan_to_num(np.minimum(one.residual / most, 1), nan=0)
        level = np.where(np.isfinite(one.residual), np.rint(share * (_NONE - 1)), _NONE)
        found["residual"] = _base64(level.astype(np.uint8))
    return found


def _nice(value: float) -> float:
    """The next larger 1, 2 or 5 times a power of ten; 1 of what is not positive."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next((k * power for k in (1, 2, 5) if k * power >= value), 10 * power))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _distinct(count: int) -> list[list[int]]:
    """Colours that are told apart."""
    from matplotlib import colormaps

    if count <= 10:
        return _bytes(colormaps["tab10"](np.arange(max(count, 1))))
    return _bytes(colormaps["hsv"](np.arange(count) / count) * 0.8)


def _bytes(colours: Float[np.ndarray, "n 4"]) -> list[list[int]]:
    """Colours in 0..1 as lists of red, green and blue in 0..255."""
    found: list[list[int]] = np.rint(255 * colours[:, :3]).astype(int).tolist()
    return found
