"""Mattresses with what lies on them, and head- and footboards: the parts of beds."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.parts import box, extrude, loft, move, pillow, rounded_box, turn
from qs3.meshes.mesh import Mesh


def cover(draw: Draw, width: float, low: float, high: float, start: float, end: float) -> Mesh:
    """A duvet or blanket over a mattress from y = start to end, rumpled on top.

    Its sides hang from the height `high` down to `low`; the mattress is inside it.
    """
    x = np.linspace(-1, 1, 19)
    rumple = draw.between(0.004, 0.025)
    a, b, p, q = draw.between(3, 9), draw.between(4, 12), draw.between(0, 6), draw.between(0, 6)
    rings = []
    for y in np.linspace(start, end, 16):
        fold = rumple * (1 + np.sin(a * x + p + 2 * np.sin(b * y)) * np.cos(b * y + q))
        edge = 1 - 0.7 * np.abs(x) ** 12 - (0.35 if y in (start, end) else 0.0)
        top = np.stack([x * width / 2, 0 * x + y, high - 0.02 + 0.045 * edge + fold], axis=1)
        flare = width / 2 + 0.012 * np.sin(7 * y + p)
        rings.append(np.concatenate([top, [(flare, y, low), (-flare, y, low)]]))
    return loft(np.stack(rings))


def pillows(draw: Draw, width: float, head: float, z: float, upright: bool) -> list[Mesh]:
    """One or two pillows lying or leaning at the head, sometimes small cushions before them."""
    count, parts = (1 if width < 1.25 else 2), []
    wide, deep, high = min(0.42 * width, 0.72) if count > 1 else 0.6, 0.42, draw.between(0.11, 0.18)
    if count == 1:
        wide = min(wide, 0.85 * width)
    lean, layers = draw.pick(0.0, 8.0, 15.0, 55.0 if upright else 4.0), draw.pick(1, 1, 2)
    for k in range(count):
        for layer in range(layers):
            x = width * ((k + 0.5) / count - 0.5) + draw.between(-0.03, 0.03)
            body = turn(move(pillow((wide, deep, high)), (0, 0, -high / 2)), lean, "x")
            body = turn(body, draw.between(-7, 7))
            rise = 0.5 * high + 0.5 * (deep - high) * float(np.sin(np.radians(lean)))
            y = head - 0.5 * deep * float(np.cos(np.radians(lean))) - 0.07 - 0.12 * layer
            parts.append(move(body, (x, y, z + rise + (0.7 * high * layer if lean < 50 else 0))))
    for k in range(draw.pick(0, 0, 1, 2) if upright else 0):
        body = turn(move(pillow((0.38, 0.38, 0.13)), (0, 0, -0.06)), draw.between(45, 65), "x")
        parts.append(move(body, (0.4 * k - 0.1, head - 0.52, z + 0.17)))
    return parts


def bedding(
    draw: Draw, width: float, length: float, z: float, thick: float, *, upright: bool = True
) -> list[Mesh]:
    """A mattress at height z with its pillows and mostly a cover; the head is at +y.

    Pillows may stand `upright` against a headboard.
    """
    parts = [rounded_box((width, length, thick), (0, 0, z), radius=0.05, crown=0.012)]
    reach = z + thick - 0.01  # no cover hangs through the floor
    if draw.chance(0.85):
        parts += pillows(draw, width, length / 2, z + thick, upright)
    kind, foot = draw.pick("duvet", "duvet", "duvet", "throw", "bare"), -length / 2
    if kind == "duvet":
        drop, end = (
            min(reach, draw.between(0.4, 1.3) * thick),
            foot + draw.between(0.62, 0.8) * length,
        )
        parts.append(cover(draw, width + 0.05, z + thick - drop, z + thick, foot - 0.025, end))
        if draw.chance(0.3):  # turned down
            parts.append(cover(draw, width + 0.055, z + thick, z + thick + 0.03, end - 0.3, end))
    elif kind == "throw":
        end, drop = foot + draw.between(0.45, 0.7), min(reach, draw.between(0.5, 1.2) * thick)
        start = foot + draw.between(0.05, 0.2)
        parts.append(cover(draw, width + 0.03, z + thick - drop, z + thick - 0.01, start, end))
    return parts


def board(draw: Draw, width: float, y: float, top: float, *kinds: str) -> list[Mesh]:
    """A head- or footboard standing on the floor, its inner face at y, outwards along +y."""
    kind = draw.pick(*(kinds or ("panel", "padded", "slats", "arch", "winged", "framed")))
    t = draw.between(0.03, 0.06)
    if kind == "padded":
        channels, t = draw.count(1, 7), 0.09
        each = width / channels
        parts = [box((width - 0.02, 0.04, top - 0.03), (0, y + 0.07, 0))]
        for k in range(channels):
            at = (each * (k + 0.5) - width / 2, y + t / 2, 0.2)
            parts.append(rounded_box((each, t, top - 0.2), at, radius=0.035))
        return parts
    if kind == "winged":
        parts = [rounded_box((width + 0.1, 0.1, top), (0, y + 0.05, 0), radius=0.03)]
        for s in (-1, 1):
            at = (s * (width / 2 + 0.05), y - 0.04, 0)
            parts.append(rounded_box((0.08, 0.24, top), at, radius=0.03))
        return parts
    if kind == "arch":
        angle = np.linspace(0, np.pi, 17)
        rise = draw.between(0.1, 0.25)
        curve = [(width / 2 * np.cos(a), top - rise + rise * np.sin(a)) for a in angle]
        outline = np.array([(-width / 2, 0), (width / 2, 0), *curve])
        return [move(extrude(outline, t, "y"), (0, y, 0))]
    if kind in ("slats", "framed"):
        post = draw.between(0.05, 0.08)
        parts = [
            box((post, post, top + 0.04), (s * (width - post) / 2, y + post / 2, 0))
            for s in (-1, 1)
        ]
        parts += [box((width - post, t, 0.08), (0, y + t / 2, z)) for z in (0.3 * top, top - 0.08)]
        if kind == "framed":
            return [*parts, box((width - post, 0.02, 0.7 * top), (0, y + t / 2, 0.3 * top))]
        count = int(width / draw.between(0.09, 0.2))
        for k in range(1, count):
            x = width * (k / count - 0.5)
            parts.append(box((0.035, 0.02, 0.68 * top), (x, y + t / 2, 0.31 * top)))
        return parts
    return [rounded_box((width, t, top), (0, y + t / 2, 0), radius=0.01, steps=2)]
