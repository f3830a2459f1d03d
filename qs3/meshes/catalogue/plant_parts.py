"""What plants are made of: pots, leaves, leafy branches."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.parts import (
    Vector,
    arc,
    cylinder,
    ellipse,
    leaf,
    move,
    rod,
    rounded_rectangle,
    shell,
)
from qs3.meshes.mesh import Mesh


def draw_pot(draw: Draw, width: float) -> tuple[list[Mesh], float, float]:
    """A pot with soil, the height of the soil and the radius of its opening."""
    r, height = 0.5 * width, width * draw.between(0.7, 1.2)
    foot, wall = draw.between(0.6, 0.95), 0.94
    soil = draw.between(0.82, 0.93) * height
    kind = draw.count(0, 3)
    shapes: list[list[tuple[float, float]]] = [
        [(foot, 0), (0.97, 0.82), (1.06, 0.82), (1.06, 1)],  # clay with a rim
        [(foot, 0), (1, 1)],
        [(0.6, 0), (0.95, 0.25), (1.12, 0.55), (1.05, 0.85), (1, 1)],  # belly
        [(1, 0), (1, 1)],
    ]
    profile = [(scale, z * height) for scale, z in shapes[kind]] + [(wall, height), (wall, soil)]
    square = kind in (1, 3) and draw.chance(0.35)
    curve = rounded_rectangle(width, width, 0.1 * width) if square else ellipse(width, width, 24)
    parts = [shell(curve, profile)]
    if draw.chance(0.25):
        parts.append(move(cylinder(1.1 * r, 0.02, top=1.2 * r, sides=24), (0, 0, -0.012)))
    elif draw.chance(0.15):  # on a stand of wood
        lift = draw.between(0.1, 0.3)
        parts = [move(part, (0, 0, lift)) for part in parts]
        parts.append(cylinder(0.9 * r, 0.02, (0, 0, lift - 0.015), sides=20))
        for k in range(4):
            a = np.radians(45 + 90 * k)
            x, y = 0.75 * r * np.cos(a), 0.75 * r * np.sin(a)
            parts.append(rod((x, y, lift), (1.3 * x, 1.3 * y, 0), 0.014))
        soil += lift
    return parts, soil, 0.9 * r


def toward(heading: float, pitch: float = 0.0) -> np.ndarray:
    """Unit vector by compass and elevation in degrees."""
    a, e = np.radians(heading), np.radians(pitch)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def blade(
    base: Vector,
    heading: float,
    pitch: float,
    length: float,
    width: float,
    droop: float = 0.3,
    belly: float = 0.4,
    steps: int = 4,
) -> Mesh:
    """A leaf that starts at `base` in a direction and sinks by droop * length at its tip."""
    start = np.asarray(base, dtype=np.float64)
    way = toward(heading, pitch)
    tip = start + length * (way - np.array([0, 0, droop]))
    tip[2] = max(tip[2], 0.01)  # a long leaf may reach the floor, not pass it
    path = arc(start, start + 0.55 * length * way, tip, steps)
    return leaf(path, width, across=toward(heading + 90), belly=belly)


def leaves_along(
    draw: Draw, path: np.ndarray, count: int, length: float, width: float, first: float = 0.2
) -> list[Mesh]:
    """Leaves in a spiral around a branch, smaller towards its tip."""
    parts, heading = [], draw.between(0, 360)
    for t in np.linspace(first, 1, count):
        heading += 137.5 + draw.between(-25, 25)
        k = t * (len(path) - 1)
        i = min(int(k), len(path) - 2)
        base = path[i] + (k - i) * (path[i + 1] - path[i])
        size = length * draw.between(0.75, 1.1) * (1.1 - 0.35 * t)
        pitch, droop = draw.between(5, 55), draw.between(0.15, 0.6)
        parts.append(blade(base, heading, pitch, size, width * size / length, droop))
    return parts
