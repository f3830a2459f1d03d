"""Monitors: flat screens on stands, tubes, televisions, all-in-ones; the screen faces -y."""

import numpy as np

from qs3.catalogue import furniture as f
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


def screen_size(draw: Draw, low: float, high: float) -> tuple[float, float]:
    """Width and height of a screen whose diagonal is between two lengths in metres."""
    diagonal, ratio = draw.between(low, high), draw.pick(16 / 9, 16 / 9, 16 / 10, 5 / 4, 4 / 3)
    height = diagonal / np.hypot(ratio, 1)
    return float(ratio * height), float(height)


def bezel(width: float, height: float, edge: float, chin: float, lip: float) -> list[Mesh]:
    """The four bars around a screen about the origin, `lip` before its face at y = 0."""
    x, z, y = 0.5 * (width - edge), 0.5 * height, 0.5 * (0.004 - lip)
    parts = f.both_sides(p.box((edge, lip + 0.004, height), (x, y, -z)))
    parts.append(p.box((width, lip + 0.004, edge), (0, y, z - edge)))
    return [*parts, p.box((width, lip + 0.004, chin), (0, y, -z))]


def panel(draw: Draw, width: float, height: float, chin: float = 0.0) -> list[Mesh]:
    """A flat screen about the origin facing -y: bezel, body and a bulge behind."""
    depth, edge = draw.between(0.012, 0.035), draw.between(0.007, 0.028)
    plate = p.slab(p.rounded_rectangle(width, height, draw.between(0.002, 0.015)), depth)
    parts = [p.turn(plate, -90, "x")]
    parts += bezel(width, height, edge, edge + chin, draw.between(0.002, 0.006))
    w, h = draw.between(0.45, 0.85) * width, draw.between(0.4, 0.75) * height
    back = p.frustum((w, h), (0.8 * w, 0.75 * h), draw.between(0.01, 0.05))
    low = -draw.between(0.0, 0.1) * height
    return [*parts, p.move(p.turn(back, -90, "x"), (0, depth - 0.002, low))]


def place(parts: list[Mesh], tilt: float, z: float, y: float = 0.0) -> list[Mesh]:
    """Lean a panel back by `tilt` degrees and lift its centre to z."""
    return [p.move(p.turn(part, -tilt, "x"), (0, y, z)) for part in parts]


def foot(draw: Draw, width: float) -> list[Mesh]:
    """What stands on the desk: a plate, an oval or two spread legs."""
    depth, h, kind = draw.between(0.16, 0.24), draw.between(0.008, 0.02), draw.count(0, 2)
    if kind == 0:
        return [p.slab(p.rounded_rectangle(width, depth, 0.03), h)]
    if kind == 1:
        return [p.slab(p.ellipse(width, depth, 32), h)]
    end, rear = (0.5 * width, -0.55 * depth, 0.008), (0.25 * width, 0.5 * depth, 0.008)
    legs = [p.beam((0, 0.01, 0.015), tip, (0.035, 0.016), 0.6) for tip in (end, rear)]
    return [p.cylinder(0.035, 0.03), *(part for leg in legs for part in f.both_sides(leg))]


def flat_stand(draw: Draw) -> list[Mesh]:
    """The office monitor: a panel on a neck and a foot, sometimes turned upright."""
    width, height = screen_size(draw, 0.43, 0.75)
    if draw.chance(0.2):
        width, height = height, width
    centre = draw.between(0.05, 0.2) + 0.5 * height
    back, neck = draw.between(0.06, 0.1), draw.between(0.04, 0.09)
    parts = place(panel(draw, width, height), draw.between(-3, 18), centre)
    top = (0, back, centre + draw.between(-0.05, 0.03))
    parts.append(p.beam((0, back + draw.between(0, 0.03), 0.005), top, (neck, 0.025)))
    parts.append(p.beam((0, back, top[2]), (0, 0.02, centre), (0.1, 0.09)))
    base = foot(draw, draw.between(0.18, 0.3))
    return parts + [p.move(part, (0, 0.7 * back, 0)) for part in base]


def tube(draw: Draw) -> list[Mesh]:
    """A deep body that narrows backwards, a bulged glass, a swivel foot or a case below."""
    width, height = draw.between(0.34, 0.5), draw.between(0.32, 0.44)
    depth, mask = draw.between(0.34, 0.48), draw.between(0.06, 0.14)
    edge = draw.between(0.025, 0.045)
    shape, narrow = p.rounded_rectangle(width, height, 0.02), draw.between(0.5, 0.72)
    low, clear = draw.between(0.0, 0.12) * height, draw.between(0.03, 0.16)
    stages = [(1.0, 0.0), (1.0, mask), (0.88, mask + 0.02), (narrow, 0.85 * depth)]
    rings = []
    for scale, y in [*stages, (0.9 * narrow, depth)]:
        drop = low * (1 - scale) / (1 - narrow)
        rings.append(np.insert(shape * scale - (0, drop), 1, y, axis=1))
    glass = p.rounded_rectangle(width - 2 * edge, height - 2 * edge - 0.02, 0.04)
    bulge = [(1.0, 0.01), (1.0, 0.0), (0.8, -0.007), (0.5, -0.013), (0.2, -0.016)]
    face = [np.insert(glass * scale + (0, 0.012), 1, y, axis=1) for scale, y in bulge]
    parts = [p.loft(np.stack(rings)), p.loft(np.stack(face))]
    parts += bezel(width, height, edge, edge + 0.022, draw.between(0.012, 0.025))
    parts = place(parts, draw.between(0, 8), clear + 0.5 * height)
    y = 0.45 * depth
    if clear > 0.08:  # a flat computer case
        return [*parts, p.box((draw.between(0.36, 0.46), depth, clear - 0.01), (0, y, 0))]
    parts.append(p.cylinder(0.28 * width, 0.025, (0, y, 0), top=0.25 * width, sides=24))
    return [*parts, p.cylinder(0.16 * width, clear + 0.06, (0, y, 0.02), sides=20)]


def tv_feet(draw: Draw) -> list[Mesh]:
    """A wide flat television on two feet."""
    diagonal, clear = draw.between(0.75, 1.45), draw.between(0.05, 0.09)
    width, height = 0.872 * diagonal, 0.49 * diagonal
    parts = place(panel(draw, width, height), 0, clear + 0.5 * height)
    x, reach = draw.between(0.25, 0.44) * width, draw.between(0.1, 0.15)
    if draw.chance(0.5):
        for y in (-reach, reach):
            leg = p.beam((x, 0.01, clear + 0.02), (x + 0.02, y, 0.006), (0.022, 0.012))
            parts += f.both_sides(leg)
    else:
        parts += f.both_sides(p.box((0.025, 2 * reach, 0.012), (x, 0.01, 0)))
        parts += f.both_sides(p.box((0.02, 0.02, clear + 0.03), (x, 0.015, 0)))
    return parts


def all_in_one(draw: Draw) -> list[Mesh]:
    """A panel with a chin on one bent sheet of metal."""
    width, height = screen_size(draw, 0.55, 0.78)
    chin, clear = draw.between(0.05, 0.09), draw.between(0.05, 0.12)
    centre, sheet = clear + 0.5 * (height + chin), draw.between(0.14, 0.22)
    parts = place(panel(draw, width, height + chin, chin), draw.between(2, 10), centre)
    front, back = -draw.between(0.08, 0.12), draw.between(0.07, 0.12)
    bend = p.arc((0, 0.6 * back, 0.006), (0, back, 0.006), (0, 0.9 * back, 0.07), 6)
    path = np.concatenate([[(0, front, 0.006)], bend, [(0, 0.03, centre + 0.02)]])
    return [*parts, p.sweep(p.rectangle(sheet, 0.01), path)]


def tv_pedestal(draw: Draw) -> list[Mesh]:
    """An older, thick television: loudspeakers next to or below the screen, a broad foot."""
    diagonal, clear = draw.between(0.65, 1.15), draw.between(0.05, 0.1)
    width, height, thick = 0.872 * diagonal, 0.49 * diagonal, draw.between(0.06, 0.12)
    below = draw.chance(0.6)
    wide, tall = (width, height + 0.08) if below else (width + 0.22, height)
    z = clear + 0.5 * tall
    back = p.frustum((0.7 * wide, 0.7 * tall), (0.5 * wide, 0.5 * tall), 0.06)
    body = p.rounded_box((wide, tall, thick), radius=0.02)
    parts = place([p.turn(body, -90, "x")], 0, z)
    parts += place([p.turn(back, -90, "x")], 0, z, thick - 0.01)
    parts += place(panel(draw, width - 0.01, height - 0.01), 0, z + 0.04 * below, -0.01)
    if below:
        parts.append(p.box((0.8 * width, 0.02, 0.045), (0, -0.004, clear + 0.015)))
    else:
        at = (0.5 * (width + 0.11), -0.004, clear + 0.075 * height)
        parts += f.both_sides(p.box((0.07, 0.02, 0.85 * height), at))
    wide, deep, y = draw.between(0.45, 0.7) * width, draw.between(0.22, 0.3), 0.5 * thick
    parts.append(p.box((draw.between(0.3, 0.6) * wide, 0.06, clear + 0.03), (0, y, 0.01)))
    shape = draw.pick(p.ellipse(wide, deep, 32), p.rounded_rectangle(wide, deep, 0.04))
    return [*parts, p.slab(shape, 0.025, (0, y, 0))]


FAMILIES = families_of(train=(flat_stand, tube, tv_feet), test=(all_in_one, tv_pedestal))
