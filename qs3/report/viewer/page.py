"""One HTML page with clouds that can be turned: coordinates, style and script are inside.

Coordinates have 16 bits of the cloud's longest side, so a page of 50 clouds of 2,048 points has
less than a megabyte. Names are not trusted: they are data in the page, never HTML, and its policy
(`Content-Security-Policy`) runs the one script whose hash it names and loads nothing from
anywhere.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import ConfigError, DataError
from qs3.geometry.orthographic import AZIMUTH_DEG, ELEVATION_DEG
from qs3.report.viewer import COLOURS, MOST_CLOUDS, MOST_IN_ALL, MOST_POINTS
from qs3.utils import html
from qs3.utils.text_table import printable
from qs3.utils.version import VERSION

_USUAL = 50 * 2048  # points of a page, if nobody says how many
_USUAL_CLOUD = 50_000  # and of one cloud
_NAMED = 10  # failures
_NONE, _VIEWS = 255, 255
_OF_PROVENANCE = ("view", "residual")  # colours that a generated dataset's table knows
_RESIDUAL_SHARE = 0.9  # of residuals, that the colours tell apart
_LEVELS = 65535
_BESIDE_DEG = 20.0  # of the camera: straight from there a scan looks whole

_BAR = """<div id="bar"><div>
<label>colour <select id="colour"></select></label>
<label>show <select id="list"></select></label>
<span class="only several"><button id="before" title="Page up">&lsaquo;</button>
<button id="after" title="Page down">&rsaquo;</button>
<button id="back" title="Esc">all</button></span>
<label class="many">find <input id="words" type="search"></label><span id="count" class="soft">
</span>
<label class="many"><input id="together" type="checkbox" checked> turn together</label>
<label class="many"><input id="true-size" type="checkbox"> same scale</label>
<label>points <input id="size" type="range" min="-1.5" max="1.5" step="0.25" value="0"></label>
<button id="reset">reset</button>
<span class="soft many">drag turns, a click enlarges</span>
<span class="soft only">drag turns, shift and drag moves, the wheel zooms</span>
</div><div id="legend"></div></div>"""


@dataclass(frozen=True, eq=False)
class Shown:
    """A cloud on the page, and what is known of it.

    Attributes:
        name: anything.
        points: [n, 3] finite, z up, n >= 1.
        label: its class; "" if nobody knows it.
        called: what a net says it is; "" if none was asked.
        sure: with which confidence, in [0, 1]; None likewise.
        note: more to say below it.
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
    """How many points each of so many clouds may have: `asked`, else what keeps a page small.

    Raises:
        ConfigError: so many clouds of so many points are too much for a browser.
    """
    if clouds > MOST_CLOUDS:
        raise ConfigError(f"clouds={clouds}: a page holds {MOST_CLOUDS} at most")
    if asked is None:
        return min(_USUAL // max(clouds, 1), _USUAL_CLOUD)
    if asked > MOST_POINTS:
        raise ConfigError(f"points={asked}: a cloud on a page has {MOST_POINTS} at most")
    if asked * clouds > MOST_IN_ALL:
        raise ConfigError(
            f"{clouds} clouds of {asked} points are more than the {MOST_IN_ALL} points of a page; "
            "give fewer clouds= or points="
        )
    return asked


def captions(parts: Sequence[Part], points: int | None = None) -> tuple[list[str], list[str]]:
    """What is shown, a line each; and what is not, to be noticed. Also for a terminal."""
    most = points_each(sum(len(part.shown) for part in parts), points)
    about = [part.about for part in parts]
    if any(len(one.points) > most for part in parts for one in part.shown):
        about.append(f"at most {most} points of a cloud are shown; points= says how many")
    failed = [words for part in parts for words in part.failed]
    notes = [f"not read: {words}" for words in failed[:_NAMED]]
    return about, notes + [f"not read: {len(failed) - _NAMED} more"] * (len(failed) > _NAMED)


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


def page(title: str, parts: Sequence[Part], *, colour: str = "", points: int | None = None) -> str:
    """The page as HTML.

    Args:
        title: of the page.
        parts: of clouds, in order.
        colour: of `COLOURS`, which comes first; "" for the height.
        points: of each cloud, at most; None: what keeps the page below a megabyte or so.

    Raises:
        ConfigError: too large for a page, or nothing is known of `colour`.
        DataError: no clouds.
    """
    whole = [one for part in parts for one in part.shown]
    failed = [words for part in parts for words in part.failed]
    if not whole:
        raise DataError("\n".join(["there is no cloud to show", *failed[:_NAMED]]))
    most = points_each(len(whole), points)
    shown = [thinned(one, most) for one in whole]
    modes = _modes(shown)
    if colour and colour not in modes:
        how = "; a dataset has it if it was made with provenance=true"
        raise ConfigError(
            f"colour={colour}: nothing is known of it here; there are {', '.join(modes)}"
            + how * (colour in _OF_PROVENANCE)
        )
    units = {part.unit for part in parts}
    data = _data(shown, modes, colour) | {
        "unit": units.pop() if len(units) == 1 else "",
        "residual_of": "; ".join(dict.fromkeys(p.residual_of for p in parts if p.residual_of)),
    }
    about, notes = captions(parts, points)
    # "<" could end the element or begin a comment in it; JSON has another way to write it.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    here = Path(__file__).parent
    script, style = ((here / f"viewer.{kind}").read_text("utf-8") for kind in ("js", "css"))
    lines = [
        *(f'<p class="soft">{_text(line)}</p>' for line in about),
        *(f'<p class="note">{_text(line)}</p>' for line in notes),
        "<noscript><p>Clouds are drawn by JavaScript, which is off here.</p></noscript>",
        _BAR,
        f'<div id="grid"></div><p class="soft">qs3 {escape(VERSION)}</p>',
        f'<script type="application/json" id="clouds">{text}</script>',
        f"<script>{script}</script>",
    ]
    return html.document(printable(title), style, lines, policy=_policy(script, style))


def _text(words: str) -> str:
    return escape(printable(words))


def _policy(script: str, style: str) -> str:
    def named(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    return f"default-src 'none'; script-src {named(script)}; style-src {named(style)}"


def _modes(shown: Sequence[Shown]) -> list[str]:
    """Which colours say something here."""
    known = {
        "height": True,
        "view": any(one.view is not None for one in shown),
        "residual": any(one.residual is not None for one in shown),
        "class": any(one.label or one.called for one in shown),
        "confidence": any(one.sure is not None for one in shown),
    }
    return [name for name in COLOURS if known[name]]


def _data(shown: Sequence[Shown], modes: Sequence[str], colour: str) -> dict[str, Any]:
    from matplotlib import colormaps

    known = [one.residual[np.isfinite(one.residual)] for one in shown if one.residual is not None]
    residuals = np.concatenate([*known, np.empty(0)])
    most = nice(float(np.quantile(residuals, _RESIDUAL_SHARE))) if len(residuals) else 1.0
    classes = sorted({name for one in shown for name in (one.label or one.called,) if name})
    views = sorted({int(k) for one in shown if one.view is not None for k in np.unique(one.view)})
    return {
        "clouds": [_cloud(one, most) for one in shown],
        "start": {"azimuth": AZIMUTH_DEG, "elevation": ELEVATION_DEG},
        "modes": modes,
        "colour": colour or modes[0],
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
        "name": one.name,
        "label": one.label,
        "called": one.called,
        "sure": one.sure,
        "note": one.note,
        "count": len(xyz),
        "of": one.of,
        "size": [float(f"{side:.6g}") for side in size],
        "radius": float(np.linalg.norm(xyz - low - size / 2, axis=1).max()) or 1.0,
        "step": step,
        "turn": turn_deg(low, size),
        "xyz": _base64(np.rint((xyz - low) / step).astype("<u2")),
    }
    if one.view is not None:
        found["view"] = _base64(np.minimum(one.view, _VIEWS).astype(np.uint8))
    if one.residual is not None:
        share = np.nan_to_num(np.minimum(one.residual / most, 1), nan=0)
        level = np.where(np.isfinite(one.residual), np.rint(share * (_NONE - 1)), _NONE)
        found["residual"] = _base64(level.astype(np.uint8))
    return found


def turn_deg(low: np.ndarray, size: np.ndarray) -> float:
    """Degrees to turn the viewer by: what lies beside the origin is first seen from there.

    That is where a scan has its camera; what lies around the origin is seen as in all pictures.
    """
    middle = (low + size / 2)[:2]
    if np.linalg.norm(middle) <= np.linalg.norm(size[:2]) / 2:
        return 0.0
    return round(float(np.rad2deg(np.arctan2(*-middle[::-1]))) - _BESIDE_DEG - AZIMUTH_DEG, 1)


def nice(value: float) -> float:
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
    hues = np.arange(count) / count
    return _bytes(colormaps["hsv"](hues) * 0.8)


def _bytes(colours: np.ndarray) -> list[list[int]]:
    """[n, 4] in 0..1 as lists of red, green and blue in 0..255."""
    found: list[list[int]] = np.rint(255 * colours[:, :3]).astype(int).tolist()
    return found
