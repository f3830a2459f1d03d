"""Vessels with walls of real thickness, taps and feet: the parts of bathtubs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.parts import (
    arc,
    cylinder,
    ellipse,
    ellipsoid,
    loft,
    move,
    ring_at,
    rod,
    rounded_rectangle,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh

Outline = Callable[[float, float], np.ndarray]


def oval_outline(power: float) -> Outline:
    """Superellipses: 2 is an ellipse, more is nearer to a rectangle."""

    def outline(width: float, depth: float) -> np.ndarray:
        unit = ellipse(2, 2, 40)
        return np.sign(unit) * np.abs(unit) ** (2 / power) * (width / 2, depth / 2)

    return outline


def rounded_outline(radius: float) -> Outline:
    """Rectangles with corners of this radius."""
    return lambda width, depth: rounded_rectangle(width, depth, radius, 6)


def vessel(outer: Sequence[np.ndarray], inner: Sequence[np.ndarray]) -> Mesh:
    """One solid from rings [N, 3]: outside from the foot up, then inside from the rim down."""
    return loft(np.stack([*outer, *inner]))


def hollow_rings(
    draw: Draw, outline: Outline, size: tuple[float, float], floor: float, top: float, shift: float
) -> list[np.ndarray]:
    """The inner rings of a tub whose opening has this size, down to a smaller floor.

    Its ends lean more than its sides, and the backrest, towards -x * shift, most of all.
    """
    width, depth = size
    lean, side = draw.between(0.1, 0.2) * width, draw.between(0.06, 0.14) * depth
    rings = []
    for t, s in [
        (0, 0),
        (0.04, 0.03),
        (0.35, 0.3),
        (0.7, 0.62),
        (0.88, 0.95),
        (0.96, 1.35),
        (1, 2.0),
    ]:
        curve = outline(width - 2 * lean * s, depth - 2 * side * s)
        rings.append(
            ring_at(curve + np.array([0.4 * shift * lean * s, 0]), top - t * (top - floor))
        )
    return rings


def rolled_rim(
    outline: Outline, width: float, depth: float, top: float, r: float
) -> list[np.ndarray]:
    """Rings of a rolled rim of radius r around an opening (width, depth)."""
    return [
        ring_at(
            outline(width + 2 * r * (1 - np.cos(a)), depth + 2 * r * (1 - np.cos(a))),
            top + r * np.sin(a),
        )
        for a in np.linspace(1.3 * np.pi, 0, 8)
    ]


def rim_tap(draw: Draw, x: float, y: float, z: float, heading: float) -> list[Mesh]:
    """A spout and handles on the rim at (x, y, z), pointing by degrees from +x."""
    reach, rise = draw.between(0.12, 0.2), draw.between(0.08, 0.22)
    spout = arc((0, 0, 0), (0, 0, 2 * rise), (reach, 0, 0.6 * rise), 8)
    parts = [tube(spout, draw.between(0.012, 0.02)), cylinder(0.028, 0.02, sides=12)]
    if draw.chance(0.7):
        lever = draw.chance(0.5)
        for s in (-1, 1):
            parts.append(cylinder(0.02, 0.05, (0, 0.09 * s, 0), sides=10))
            if lever:
                parts.append(rod((0, 0.09 * s, 0.05), (0.05, 0.14 * s, 0.065), 0.007, sides=6))
            else:
                for arm in (np.array([0.03, 0, 0]), np.array([0, 0.03, 0])):
                    hub = np.array([0, 0.09 * s, 0.05])
                    parts.append(rod(hub - arm, hub + arm, 0.009, sides=6))
    return [move(turn(p, heading), (x, y, z)) for p in parts]


def floor_tap(draw: Draw, x: float, y: float, top: float, heading: float) -> list[Mesh]:
    """A tap that stands on the floor beside a tub, with a hand shower."""
    tall, r = top + draw.between(0.2, 0.4), draw.between(0.014, 0.022)
    path = np.concatenate(
        [
            [(0, 0, 0), (0, 0, 0.5 * tall)],
            arc((0, 0, tall - 0.08), (0, 0, tall), (0.24, 0, tall), 6),
        ]
    )
    parts = [tube(path, r), cylinder(0.05, 0.015, sides=14)]
    parts.append(rod((0, -0.1, top + 0.08), (0, 0.1, top + 0.08), 0.016))
    parts.append(rod((0, 0.09, top + 0.03), (0.02, 0.09, top + 0.24), 0.011, 0.02))
    hose = arc((0, 0.09, top + 0.05), (-0.02, 0.22, 0.2), (0, 0.02, 0.35), 12)
    parts.append(tube(hose, 0.007, sides=6))
    return [move(turn(p, heading), (x, y, 0)) for p in parts]


def fittings(draw: Draw, width: float, floor: float, top: float, end: int) -> list[Mesh]:
    """The drain in the floor and the overflow below the rim, at the end `end` of the x axis."""
    x = end * 0.22 * width
    parts = [cylinder(0.03, 0.008, (x, 0, floor), sides=14)]
    if draw.chance(0.6):
        disc = turn(cylinder(0.032, 0.03, sides=14), -90 * end, "y")
        parts.append(move(disc, (end * 0.44 * width, 0, top - 0.12)))
    return parts


def claw_feet(draw: Draw, width: float, depth: float, lift: float) -> list[Mesh]:
    """Four claw feet: a knee under the tub, an ankle, a ball on the floor."""
    parts, ball = [], draw.between(0.05, 0.075)
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * 0.29 * width, sy * 0.27 * depth
            knee, mid = (x, y, lift + 0.09), (x + 0.05 * sx, y + 0.09 * sy, lift)
            foot = (x + 0.03 * sx, y + 0.06 * sy, 0.7 * ball)
            parts.append(
                tube(arc(knee, mid, foot, 6), 0.03, scale=[1.5, 1.4, 1.2, 1, 0.8, 0.7, 0.9])
            )
            centre = (foot[0] + 0.01 * sx, foot[1] + 0.015 * sy, ball / 2)
            parts.append(ellipsoid((1.1 * ball, 1.2 * ball, ball), centre, sides=12, rings=7))
    return parts


def bowl(
    draw: Draw,
    outline: Outline,
    width: float,
    depth: float,
    lift: float,
    top: float,
    shift: float,
    *,
    wall: float = 0.02,
) -> Mesh:
    """A round-bottomed tub of cast iron, from `lift` up to `top`, with a rolled rim."""
    roll = draw.between(0.018, 0.03)
    w, d = width - 2 * roll, depth - 2 * roll
    hollow = hollow_rings(draw, outline, (w - 2 * wall, d - 2 * wall), lift + 0.03, top, shift)
    outer = []
    # the outside follows the inside at the wall's thickness
    for ring in hollow[:0:-1]:
        middle = ring[:, :2].mean(axis=0)
        extent = np.abs(ring[:, :2] - middle).max(axis=0)
        curve = (ring[:, :2] - middle) * (extent + wall) / extent + middle
        outer.append(ring_at(curve, ring[0, 2] - 0.03 * (ring[0, 2] < lift + 0.15)))
    return vessel([*outer, *rolled_rim(outline, w, d, top, roll)], hollow)
