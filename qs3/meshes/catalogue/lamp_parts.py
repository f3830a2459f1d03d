"""What lamps are made of: shades, bulbs, reflectors and feet."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.parts import (
    arc,
    cylinder,
    lathe,
    move,
    rod,
    rounded_rectangle,
    slab,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh

Point = tuple[float, float, float]


def shade(lower: float, upper: float, height: float, at: Point) -> list[Mesh]:
    """A fabric shade open at both ends, its spider and its bulb; `at` is its lower centre."""
    t = 0.006
    z = at[2] + 0.8 * height
    reach = lower + 0.8 * (upper - lower) - 0.5 * t
    spider = [
        rod((at[0] - dx, at[1] - dy, z), (at[0] + dx, at[1] + dy, z), 0.004, sides=6)
        for dx, dy in [(reach, 0.0), (0.0, reach)]
    ]
    profile = [(lower, 0), (upper, height), (upper - t, height), (lower - t, 0)]
    return [lathe(profile, at, sides=28, loop=True), *spider, bulb((*at[:2], z - 0.09))]


def bulb(at: Point) -> Mesh:
    """An electric bulb that hangs; `at` is the middle of its glass."""
    profile = [(0.013, 0.11), (0.014, 0.06), (0.03, 0.02), (0.026, -0.01), (0, -0.028)]
    return lathe(profile, at, sides=12)


def draw_shade(draw: Draw, width: float, at: Point) -> list[Mesh]:
    """A drum, an empire or a cone about as wide as `width`."""
    lower = 0.5 * width
    upper = lower * draw.pick(draw.between(0.88, 1.0), draw.between(0.5, 0.75), 0.35)
    return shade(lower, upper, width * draw.between(0.5, 0.85), at)


def hood(radius: float, height: float, neck: float, round_: bool) -> Mesh:
    """A reflector, closed above and open below; the mouth's centre is the origin."""
    t = 0.004
    if round_:
        angles = np.linspace(0, 0.5 * np.pi, 6)[:-1]
        outer = [(radius * float(np.cos(a)), height * float(np.sin(a))) for a in angles]
    else:
        outer = [(radius, 0.0), (0.5 * (radius + neck), 0.55 * height), (neck, 0.92 * height)]
    inner = [(max(r - t, 0.3 * r), 0.96 * z) for r, z in outer[::-1]]
    return lathe([(0, 0.94 * height), *inner, *outer, (0, height)], sides=22)


def aim(mesh: Mesh, tilt: float, heading: float, at: Point) -> Mesh:
    """Turn a mouth that looks down by `tilt` degrees towards -y, then about z, and place it."""
    return move(turn(turn(mesh, -tilt, "x"), heading), at)


def draw_foot(draw: Draw, width: float) -> tuple[list[Mesh], float]:
    """A stand of one of several kinds, and the height at which the pole starts."""
    kind = draw.count(0, 3)
    r, h = width / 2, draw.between(0.015, 0.035)
    if kind == 0:
        return [cylinder(r, h, top=0.93 * r, sides=28)], h
    if kind == 1:
        dome = [(r, 0), (r, 0.3 * h), (0.7 * r, 0.9 * h), (0.25 * r, 1.5 * h), (0.12 * r, 3 * h)]
        return [lathe(dome, sides=28)], 2.5 * h
    if kind == 2:
        return [slab(rounded_rectangle(1.8 * r, 1.8 * r, 0.2 * r), h)], h
    legs = draw.count(3, 4)
    top = 0.35 * width
    parts = []
    for k in range(legs):
        a = 2 * np.pi * k / legs + 0.5 * np.pi
        x, y = r * np.cos(a), r * np.sin(a)
        parts.append(tube(arc((0, 0, top), (0.5 * x, 0.5 * y, top), (x, y, 0), 6), 0.011))
    return [*parts, cylinder(0.02, 0.06, (0, 0, top - 0.03))], top
