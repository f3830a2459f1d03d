"""Bathtubs: free-standing, built in, on claw feet, raised at the ends, in corners."""

from collections.abc import Callable

import numpy as np

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import CORNERS, Draw, families_of
from qs3.meshes.mesh import Mesh

Outline = Callable[[float, float], np.ndarray]


def oval_outline(power: float) -> Outline:
    """Superellipses: 2 is an ellipse, more is nearer to a rectangle."""

    def outline(width: float, depth: float) -> np.ndarray:
        unit = p.ellipse(2, 2, 40)
        return np.sign(unit) * np.abs(unit) ** (2 / power) * (width / 2, depth / 2)

    return outline


def rounded_outline(radius: float) -> Outline:
    """Rectangles with corners of this radius."""
    return lambda width, depth: p.rounded_rectangle(width, depth, radius, 6)


def hollow_rings(
    draw: Draw, outline: Outline, size: tuple[float, float], floor: float, top: float, shift: float
) -> list[np.ndarray]:
    """The inner rings of a tub whose opening has this size, down to a smaller floor.

    Its ends lean more than its sides, and the backrest, towards -x * shift, most of all.
    """
    width, depth = size
    lean, side = draw.between(0.1, 0.2) * width, draw.between(0.06, 0.14) * depth
    steps = [(0, 0), (0.04, 0.03), (0.35, 0.3), (0.7, 0.62), (0.88, 0.95), (0.96, 1.35), (1, 2.0)]
    rings = []
    for t, s in steps:
        curve = outline(width - 2 * lean * s, depth - 2 * side * s)
        curve = curve + np.array([0.4 * shift * lean * s, 0])
        rings.append(p.ring_at(curve, top - t * (top - floor)))
    return rings


def tap(draw: Draw, x: float, y: float, z: float, heading: float) -> list[Mesh]:
    """A spout and handles at (x, y), pointing by degrees from +x, on the rim at height z.

    One next to the tub (z = 0) stands on a pipe of its own.
    """
    reach, rise = draw.between(0.12, 0.2), draw.between(0.08, 0.22)
    parts = [p.cylinder(0.028, 0.02, sides=12)]
    foot = 0.0
    if z == 0:
        foot, reach = draw.between(0.7, 0.85), 0.24
        parts.append(p.cylinder(0.018, foot + 0.01))
    spout = p.arc((0, 0, foot), (0, 0, foot + 2 * rise), (reach, 0, foot + 0.6 * rise), 8)
    parts.append(p.tube(spout, draw.between(0.012, 0.02)))
    parts.append(p.rod((0, -0.1, foot + 0.02), (0, 0.1, foot + 0.02), 0.012))
    for s in (-0.09, 0.09):
        parts.append(p.rod((0, s, foot), (0.03, s, foot + 0.07), 0.014))
    return [p.move(p.turn(part, heading), (x, y, z)) for part in parts]


def drain(width: float, floor: float, end: int) -> Mesh:
    """The drain in the floor, at the end `end` of the x axis."""
    return p.cylinder(0.03, 0.008, (end * 0.22 * width, 0, floor), sides=14)


def freestanding(draw: Draw) -> list[Mesh]:
    """A tub that stands free: oval or block-like, with flaring, straight or waisted sides."""
    width, depth, top = draw.between(1.45, 1.9), draw.between(0.7, 0.95), draw.between(0.5, 0.66)
    wall, floor, end = draw.between(0.025, 0.09), 0.12, draw.pick(-1, 1)
    foot, belly = draw.between(0.81, 0.97), draw.between(-0.035, 0.05)
    round_corners = rounded_outline(draw.between(0.12, 0.36))
    outline = draw.pick(oval_outline(draw.between(2.0, 3.2)), round_corners)
    outer = []
    for t in (0, 0.02, 0.2, 0.4, 0.6, 0.8, 0.97, 1.0):
        s = foot + (1 - foot) * t + belly * np.sin(np.pi * t) - (0.012 if t in (0, 1) else 0)
        outer.append(p.ring_at(outline(width * s, depth * s), top * t))
    hollow = hollow_rings(draw, outline, (width - 2 * wall, depth - 2 * wall), floor, top, end)
    parts = [p.loft(np.stack([*outer, *hollow])), drain(width, floor, end)]
    if draw.chance(0.45):
        parts += tap(draw, draw.between(-0.3, 0.3), depth / 2 + 0.12, 0.0, -90)
    return parts


def built_in(draw: Draw) -> list[Mesh]:
    """A rectangular tub with a flat rim and an apron, plain, ribbed or with a sunk panel."""
    width, depth, top = draw.between(1.4, 1.9), draw.between(0.68, 1.0), draw.between(0.42, 0.6)
    rim, end, floor = draw.between(0.05, 0.14), draw.pick(-1, 1), draw.between(0.08, 0.14)
    lip, inset = draw.between(0.03, 0.06), draw.between(0.0, 0.04)
    square, inside = rounded_outline(0.012), rounded_outline(draw.between(0.12, 0.35))
    head = draw.between(0.0, 0.08)  # a wider ledge at the tap end
    opening = (width - 2 * rim - head, depth - 2 * rim)
    side = [(inset, 0), (inset, top - lip), (0, top - lip), (0, top - 0.008), (0.008, top)]
    outer = [p.ring_at(square(width - 2 * cut, depth - 2 * cut), z) for cut, z in side]
    hollow = hollow_rings(draw, inside, opening, floor, top, end)
    hollow = [ring - (end * head / 2, 0, 0) for ring in hollow]
    parts = [p.loft(np.stack([*outer, *hollow])), drain(width - head, floor, end)]
    kind = draw.pick("plain", "plain", "panel", "ribs")
    if kind == "panel":
        size = (0.85 * width, 0.03, top - lip - 0.12)
        parts.append(p.rounded_box(size, (0, inset - depth / 2, 0.06), radius=0.012, steps=1))
    elif kind == "ribs":
        for x in np.linspace(-0.5, 0.5, 12) * (width - 0.1):
            parts.append(p.box((0.05, 0.02, top - lip), (x, inset - depth / 2, 0.0)))
    if draw.chance(0.65):
        parts += tap(draw, end * (width / 2 - rim / 2 - head / 2), 0, top, 90 + 90 * end)
    return parts


def bowl(draw: Draw, size: tuple[float, float], lift: float, top: float, shift: float) -> Mesh:
    """A round-bottomed tub of cast iron, from `lift` up to `top`, with a rolled rim."""
    outline, r, wall = oval_outline(draw.between(2.0, 3.4)), draw.between(0.018, 0.03), 0.03
    w, d = size[0] - 2 * r, size[1] - 2 * r
    hollow = hollow_rings(draw, outline, (w - 2 * wall, d - 2 * wall), lift + 0.03, top, shift)
    outer = []
    for ring in hollow[:0:-1]:  # the outside follows the inside at the wall's thickness
        middle = ring[:, :2].mean(axis=0)
        extent = np.abs(ring[:, :2] - middle).max(axis=0)
        curve = (ring[:, :2] - middle) * (extent + wall) / extent + middle
        outer.append(p.ring_at(curve, ring[0, 2] - 0.03 * (ring[0, 2] < lift + 0.15)))
    for a in np.linspace(1.3 * np.pi, 0, 8):
        grow = 2 * r * (1 - np.cos(a))
        outer.append(p.ring_at(outline(w + grow, d + grow), top + r * np.sin(a)))
    return p.loft(np.stack([*outer, *hollow]))


def claw_feet(draw: Draw, width: float, depth: float, lift: float) -> list[Mesh]:
    """Four claw feet: a knee under the tub, an ankle, a ball on the floor."""
    parts, ball = [], draw.between(0.05, 0.075)
    for sx, sy in CORNERS:
        x, y = sx * 0.29 * width, sy * 0.27 * depth
        foot = (x + 0.03 * sx, y + 0.06 * sy, ball / 2)
        leg = p.arc((x, y, lift + 0.09), (x + 0.05 * sx, y + 0.09 * sy, lift), foot, 6)
        parts.append(p.tube(leg, 0.03, scale=np.linspace(1.5, 0.7, 7)))
        parts.append(p.ellipsoid((1.1 * ball, 1.2 * ball, ball), foot, sides=12, rings=7))
    return parts


def claw_foot(draw: Draw) -> list[Mesh]:
    """A cast-iron tub with a rolled rim on four claw feet, its taps at the end or none."""
    width, depth, top = draw.between(1.4, 1.8), draw.between(0.7, 0.82), draw.between(0.54, 0.64)
    lift, end = draw.between(0.1, 0.17), draw.pick(-1, 1)
    parts = [bowl(draw, (width, depth), lift, top, end), drain(width, lift + 0.03, end)]
    parts += claw_feet(draw, width, depth, lift)
    if draw.chance(0.6):
        x, z = draw.pick((width / 2 - 0.04, top + 0.015), (width / 2 + 0.1, 0.0))
        parts += tap(draw, end * x, 0, z, 90 + 90 * end)
    return parts


def slipper(draw: Draw) -> list[Mesh]:
    """A tub raised at one end or both, on a plinth."""
    width, depth, top = draw.between(1.5, 1.8), draw.between(0.68, 0.8), draw.between(0.52, 0.6)
    raised, double, lift = draw.between(0.14, 0.28), draw.chance(0.35), draw.between(0.1, 0.16)
    tub, end = bowl(draw, (width, depth), lift, top, 0.0), draw.pick(-1, 1)
    x, y, z = tub.vertices.T
    u = x / (width / 2)
    along = np.abs(u) if double else np.clip(-end * u + 0.35, 0, None) / 1.35
    height = np.clip((z - lift) / (top - lift), 0, None)
    lean = 0.1 * np.sign(u) * along**2 * height  # the raised end also leans out
    shape = np.stack([x + lean, y, z + raised * along**2 * height**2], axis=1)
    base = [(0.37, 0), (0.37, 0.05), (0.33, 0.08), (0.33, lift + 0.06)]
    plinth = p.shell(oval_outline(2.4)(2 * width, 1.9 * depth), base)
    parts = [Mesh(shape, tub.faces), plinth, drain(width, lift + 0.03, end)]
    if draw.chance(0.5):
        parts += tap(draw, 0.0, depth / 2 + 0.1, 0.0, -90)
    return parts


def corner(draw: Draw) -> list[Mesh]:
    """A tub for the corner of a room: a quarter round with an oval hollow."""
    reach, top, floor = draw.between(1.2, 1.55), draw.between(0.45, 0.62), draw.between(0.1, 0.15)
    angle = np.arange(48) * (2 * np.pi / 48) + 0.01
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # from a centre near the middle, the distance to the two walls behind and to the round front
    back, low = 0.44 * reach, -0.56 * reach
    walls = np.where(ray > 0, back, low) / ray
    along, bow = ray.sum(axis=1) * back, draw.between(1.02, 1.15) * reach
    front = along + np.sqrt(along**2 - 2 * back**2 + bow**2)
    far = np.minimum(walls.min(axis=1), front)
    curve, lip, rim = ray * far[:, None], draw.between(0.03, 0.06), draw.between(0.06, 0.12)
    rings = [(0.95, 0), (0.95, top - lip), (1, top - lip), (1, top)]
    outer = [p.ring_at(curve * s, z) for s, z in rings]
    # the hollow is an ellipse across the diagonal, blended with the outline
    across, deep = ray @ (1, -1) / np.sqrt(2), ray @ (1, 1) / np.sqrt(2)
    oval = 1 / np.hypot(across / (0.58 * reach), deep / (0.38 * reach))
    blend = draw.between(0.4, 1.0)
    opening = np.minimum(blend * oval + (1 - blend) * far, far - rim)[:, None] * ray
    levels = [(1, top), (0.97, top - 0.03), (0.9, 0.5 * top), (0.78, floor + 0.06), (0.6, floor)]
    hollow = [p.ring_at(opening * s, z) for s, z in levels]
    parts = [p.loft(np.stack([*outer, *hollow])), drain(0, floor, 1)]
    if draw.chance(0.6):
        parts += tap(draw, back - 0.14, back - 0.14, top, 225)
    return [p.turn(part, 45) for part in parts]


FAMILIES = families_of(train=(freestanding, built_in, claw_foot), test=(slipper, corner))
