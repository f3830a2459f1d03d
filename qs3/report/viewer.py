"""Clouds for the viewer of the pages: coordinates of 16 bits of the cloud's longest side.

A page of 50 clouds of 2,048 points has less than a megabyte. Names are data in the page, never
HTML.
"""

import base64
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import DataError
from qs3.utils.page import render
from qs3.utils.pictures import AZIMUTH_DEG, ELEVATION_DEG, turn_deg

_USUAL = 50 * 2048  # points of a page, if points= is not given
_USUAL_CLOUD = 50_000  # and of one cloud
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
        of: points that it had before it was thinned; 0: all are here.
    """

    name: str
    points: Float[np.ndarray, "n 3"]
    label: str = ""
    called: str = ""
    sure: float | None = None
    note: str = ""
    of: int = 0


@dataclass(frozen=True, eq=False)
class Part:
    """Clouds that came together.

    `about` is a line: what they are and how many there were; `unit` is of their coordinates, ""
    if it is not known; `failed` is what could not be read, each with its reason.
    """

    shown: Sequence[Shown]
    about: str
    unit: str = ""
    failed: Sequence[str] = ()


def drawn(positions: np.ndarray, most: int, seed: int = 0) -> list[int]:
    """At most so many of some positions [n], at random, always the same ones, in order."""
    if len(positions) <= most:
        return [int(i) for i in positions]
    return sorted(np.random.default_rng(seed).choice(positions, most, replace=False).tolist())


def points_each(clouds: int, given: int | None) -> int:
    """How many points each of so many clouds has: `given`, else what keeps a page small."""
    return given or min(_USUAL // max(clouds, 1), _USUAL_CLOUD)


def thinned(one: Shown, most: int) -> Shown:
    """The cloud with at most so many of its points, drawn at random, always the same ones."""
    count = len(one.points)
    if count <= most:
        return one
    return dataclasses.replace(one, points=one.points[drawn(np.arange(count), most)], of=count)


def viewer(parts: Sequence[Part], points: int | None = None) -> dict[str, Any]:
    """What the viewer's template takes: "about" and "notes", lines each, and "data".

    Args:
        parts: of clouds, in order.
        points: of each cloud, at most; None: what keeps the page below a megabyte or so.
    """
    from matplotlib import colormaps

    whole = [one for part in parts for one in part.shown]
    failed = [words for part in parts for words in part.failed]
    if not whole:
        raise DataError("\n".join(["there is no cloud to show", *failed]))
    most = points_each(len(whole), points)
    about = [part.about for part in parts]
    if any(len(one.points) > most for one in whole):
        about.append(f"at most {most} points of a cloud are shown (points=)")
    classes = sorted({name for one in whole for name in (one.label or one.called,) if name})
    sure = any(one.sure is not None for one in whole)
    modes = ["height", *["class"] * bool(classes), *["confidence"] * sure]
    units = {part.unit for part in parts}
    table, k = ("tab10", 10) if len(classes) <= 10 else ("hsv", len(classes))
    distinct = colormaps[table]((np.arange(len(classes)) + 0.5) / k)
    data = {
        "clouds": [_cloud(thinned(one, most)) for one in whole],
        "start": {"azimuth": AZIMUTH_DEG, "elevation": ELEVATION_DEG},
        "modes": modes,
        "classes": classes,
        "ramp": _bytes(colormaps["viridis"](np.linspace(0, 1, 16))),
        "class_colours": _bytes(distinct),
        "unit": units.pop() if len(units) == 1 else "",
    }
    return {"about": about, "notes": [f"not read: {words}" for words in failed], "data": data}


def page(title: str, parts: Sequence[Part], points: int | None = None) -> str:
    """A page of clouds as HTML; see `viewer`."""
    return render("clouds.html", title=title, **viewer(parts, points))


def _cloud(one: Shown) -> dict[str, Any]:
    xyz = np.asarray(one.points, dtype=np.float64)
    low, size = xyz.min(axis=0), np.ptp(xyz, axis=0)
    step = float(size.max()) / _LEVELS or 1.0
    places = np.rint((xyz - low) / step).astype("<u2")
    return {
        **{key: getattr(one, key) for key in ("name", "label", "called", "sure", "note", "of")},
        "count": len(xyz),
        "size": [float(f"{side:.6g}") for side in size],
        "radius": float(np.linalg.norm(xyz - low - size / 2, axis=1).max()) or 1.0,
        "step": step,
        "turn": turn_deg(xyz),
        "xyz": base64.b64encode(places.tobytes()).decode("ascii"),
    }


def _bytes(colours: Float[np.ndarray, "n 4"]) -> list[list[int]]:
    """Colours in 0..1 as lists of red, green and blue in 0..255."""
    found: list[list[int]] = np.rint(255 * colours[:, :3]).astype(int).tolist()
    return found
