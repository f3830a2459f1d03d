"""Plants in pots and vases, from grass to a small tree."""

import numpy as np

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


def pot(draw: Draw, width: float) -> tuple[list[Mesh], float, float]:
    """A pot with soil, the height of the soil and the radius of its opening."""
    foot, height = draw.between(0.6, 0.95), width * draw.between(0.7, 1.2)
    soil = draw.between(0.82, 0.93) * height
    shapes: list[list[tuple[float, float]]] = [
        [(foot, 0), (0.97, 0.82), (1.06, 0.82), (1.06, 1)],  # clay with a rim
        [(foot, 0), (1, 1)],
        [(0.6, 0), (0.95, 0.25), (1.12, 0.55), (1.05, 0.85), (1, 1)],  # belly
        [(1, 0), (1, 1)],
    ]
    shape = draw.pick(*shapes)
    profile = [(scale, z * height) for scale, z in shape] + [(0.94, height), (0.94, soil)]
    square = len(shape) == 2 and draw.chance(0.35)
    curve = p.rounded_rectangle(width, width, 0.1 * width) if square else p.ellipse(width, width)
    return [p.shell(curve, profile)], soil, 0.45 * width


def toward(heading: float, pitch: float = 0.0) -> np.ndarray:
    """Unit vector by compass and elevation in degrees."""
    a, e = np.radians(heading), np.radians(pitch)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def blade(
    base: p.Vector,
    heading: float,
    pitch: float,
    length: float,
    width: float,
    droop: float = 0.3,
    belly: float = 0.4,
    steps: int = 4,
) -> Mesh:
    """A leaf that starts at `base` in a direction and sinks by droop * length at its tip."""
    start, way = np.asarray(base, dtype=np.float64), toward(heading, pitch)
    tip = start + length * (way - np.array([0, 0, droop]))
    tip[2] = max(tip[2], 0.01)  # a long leaf may reach the floor, not pass it
    path = p.arc(start, start + 0.55 * length * way, tip, steps)
    return p.leaf(path, width, across=toward(heading + 90), belly=belly)


def leaves_along(
    draw: Draw, path: np.ndarray, count: int, length: float, width: float, first: float = 0.2
) -> list[Mesh]:
    """Leaves in a spiral around a branch, smaller towards its tip."""
    parts, heading = [], draw.between(0, 360)
    for t in np.linspace(first, 1, count):
        heading += 137.5 + draw.between(-25, 25)
        i = min(int(t * (len(path) - 1)), len(path) - 2)
        base = path[i] + (t * (len(path) - 1) - i) * (path[i + 1] - path[i])
        size = length * draw.between(0.75, 1.1) * (1.1 - 0.35 * t)
        pitch, droop = draw.between(5, 55), draw.between(0.15, 0.6)
        parts.append(blade(base, heading, pitch, size, width * size / length, droop))
    return parts


def potted_leaves(draw: Draw) -> list[Mesh]:
    """Broad leaves on arching stems from the middle of a pot."""
    width = draw.between(0.16, 0.34)
    parts, soil, r = pot(draw, width)
    count, reach = draw.count(16, 30), width * draw.between(0.7, 1.2)
    large = reach * draw.between(0.6, 0.95)
    for k in range(count):
        heading, rise = 137.5 * k + draw.between(-20, 20), draw.between(0.3, 1.6)
        base = np.array([0, 0, soil - 0.01]) + 0.4 * r * toward(heading)
        tip = base + reach * (draw.between(0.2, 0.9) * toward(heading) + (0, 0, rise))
        stem = p.arc(base, 0.5 * (base + tip) + (0, 0, 0.25 * reach), tip, 5)
        parts.append(p.tube(stem, 0.005, sides=6))
        size, drop = large * draw.between(0.75, 1.2), draw.between(0.3, 0.9)
        parts.append(blade(tip, heading, 15, size, 0.6 * size, drop, 0.35, 6))
    return parts


def bush(draw: Draw) -> list[Mesh]:
    """A dense ball of small leaves on short branches."""
    width = draw.between(0.18, 0.4)
    parts, soil, _ = pot(draw, width)
    radius, flat = width * draw.between(0.7, 1.2), draw.between(0.75, 1.2)
    size, root = radius * draw.between(0.3, 0.5), np.array([0, 0, soil - 0.01])
    centre = np.array([0, 0, soil + 0.75 * radius * flat])
    for k in range(draw.count(20, 28)):
        way = toward(137.5 * k, draw.between(-35, 80)) * (1, 1, flat)
        tip = centre + 0.85 * radius * draw.between(0.8, 1.1) * way
        path = p.arc(root, 0.5 * (root + tip) + (0, 0, 0.1 * radius), tip, 5)
        parts.append(p.tube(path, 0.004, sides=5))
        parts += leaves_along(draw, path, 8, size, 0.65 * size, 0.4)
    return parts


def small_tree(draw: Draw) -> list[Mesh]:
    """A thin trunk, or two, with a leafy crown, as tall as a person."""
    parts, soil, _ = pot(draw, draw.between(0.28, 0.42))
    height, crown = draw.between(0.9, 1.6), draw.between(0.28, 0.45)
    trunks, long = draw.count(1, 2), draw.between(0.12, 0.2)
    for k in range(trunks):
        base = np.array([0.04 * k * trunks, 0.02 * k, soil - 0.02])
        lean = 0.08 * toward(draw.between(0, 360))
        top = base + lean + np.array([0, 0, height * (1 - 0.25 * k) - crown])
        path = p.arc(base, 0.5 * (base + top) + lean, top, 8)
        parts.append(p.tube(path, 0.018, scale=np.linspace(1.1, 0.7, 9)))
        for i in range(draw.count(11, 16)):
            start = path[draw.count(5, 8)]
            end = top + crown * draw.between(0.5, 1.0) * toward(137.5 * i, draw.between(-25, 85))
            branch = p.arc(start, 0.5 * (start + end) + (0, 0, 0.08), end, 5)
            parts.append(p.tube(branch, 0.006, sides=5))
            parts += leaves_along(draw, branch, 12, long, 0.5 * long, 0.3)
    return parts


def grass(draw: Draw) -> list[Mesh]:
    """Many blades: narrow ones that arch over the rim, or broad ones that stand."""
    width, stiff = draw.between(0.12, 0.3), draw.chance(0.3)
    parts, soil, r = pot(draw, width)
    length, broad = width * draw.between(1.4, 2.8), draw.between(0.014, 0.03) * (3 if stiff else 1)
    droop = draw.between(0.3, 1.0) * (0.2 if stiff else 1)
    for k in range(draw.count(15, 25) if stiff else draw.count(50, 90)):
        heading, pitch = 137.5 * k, draw.between(65, 88) if stiff else draw.between(40, 88)
        base = np.array([0, 0, soil - 0.01]) + 0.4 * r * draw.between(0, 1) * toward(heading)
        sink = droop * draw.between(0.6, 1.3) * float(np.cos(np.radians(0.8 * pitch))) * 1.4
        size = length * draw.between(0.55, 1.05)
        parts.append(blade(base, heading, pitch, size, broad, sink, 0.3, 6))
    return parts


def vase_flowers(draw: Draw) -> list[Mesh]:
    """Flowers in a vase: stems, heads with petals, a few leaves."""
    height, r, neck = draw.between(0.18, 0.34), draw.between(0.045, 0.08), draw.between(0.5, 1.0)
    outside = [(0.7, 0), (1.0, 0.2), (1.05, 0.45), (neck, 0.8), (1.1 * neck, 1.0)]
    inside = [(0.98 * neck, 1.0), (0.85 * neck, 0.75), (0, 0.7)]
    parts = [p.lathe([(r * s, height * z) for s, z in [*outside, *inside]], sides=24)]
    spread, tall = draw.between(15, 35), height * draw.between(1.0, 1.7)
    petal, count = draw.between(0.025, 0.05), draw.count(5, 9)
    for k in range(draw.count(7, 14)):
        heading, pitch = 137.5 * k, 90 - spread * draw.between(0.1, 1.1)
        base = np.array([0, 0, 0.65 * height])
        tip = base + tall * draw.between(0.85, 1.15) * toward(heading, pitch)
        path = p.arc(base, base + np.array([0, 0, 0.5 * tall]), tip, 6)
        parts.append(p.tube(path, 0.003, sides=5))
        parts.append(p.ellipsoid((0.6 * petal, 0.6 * petal, 0.5 * petal), tip, sides=8, rings=5))
        for around in np.arange(count) * 360 / count:
            parts.append(blade(tip, around, draw.between(10, 40), petal, 0.6 * petal, 0.1, 0.6, 3))
        if draw.chance(0.7):
            parts += leaves_along(draw, path[2:], 3, 0.09, 0.035, 0.1)
    return parts


def conifer(draw: Draw) -> list[Mesh]:
    """A little fir or a clipped cone: whorls of branches that shorten upwards."""
    parts, soil, _ = pot(draw, draw.between(0.18, 0.34))
    height, spread, whorls = draw.between(0.5, 1.3), draw.between(0.2, 0.34), draw.count(8, 13)
    parts.append(p.rod((0, 0, soil - 0.02), (0, 0, soil + height), 0.018, 0.005))
    for k in range(whorls):
        t = k / whorls
        level, reach = soil + height * (0.1 + 0.9 * t), height * spread * (1.08 - t)
        for i in range(10):
            heading, pitch = 36 * i + 17 * k + draw.between(-8, 8), draw.between(-5, 20)
            size = reach * draw.between(0.85, 1.1)
            parts.append(blade((0, 0, level), heading, pitch, size, 0.3 * size + 0.02, 0.25, 0.55))
    return [*parts, blade((0, 0, soil + 0.95 * height), 0, 89, 0.12 * height, 0.03, 0.0)]


FAMILIES = families_of(
    train=(potted_leaves, bush, small_tree, grass),
    test=(vase_flowers, conifer),
)
