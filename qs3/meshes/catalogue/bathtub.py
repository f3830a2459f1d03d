"""Bathtubs: free-standing, built in, on claw feet, let into a deck, in corners, of staves."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.bathtub_parts import (
    bowl,
    claw_feet,
    fittings,
    floor_tap,
    hollow_rings,
    oval_outline,
    rim_tap,
    rounded_outline,
    vessel,
)
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.parts import (
    arc,
    box,
    cylinder,
    lathe,
    loft,
    ring_at,
    rod,
    rounded_box,
    slab,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh


def freestanding(draw: Draw) -> list[Mesh]:
    """An oval tub that stands free: flaring, straight or waisted sides, a thin or thick rim."""
    width, depth, top = draw.between(1.45, 1.85), draw.between(0.7, 0.9), draw.between(0.52, 0.66)
    outline, wall, floor = oval_outline(draw.between(2.0, 3.2)), draw.between(0.025, 0.06), 0.12
    foot, belly, end = draw.between(0.81, 0.97), draw.between(-0.035, 0.05), draw.pick(-1, 1)
    outer = []
    for t in (0, 0.02, 0.2, 0.4, 0.6, 0.8, 0.97, 1.0):
        s = foot + (1 - foot) * t + belly * np.sin(np.pi * t) - (0.012 if t in (0, 1) else 0)
        outer.append(ring_at(outline(width * s, depth * s), top * t))
    hollow = hollow_rings(draw, outline, (width - 2 * wall, depth - 2 * wall), floor, top, end)
    parts = [vessel(outer, hollow), *fittings(draw, width, floor, top, end)]
    if draw.chance(0.45):
        parts += floor_tap(draw, draw.between(-0.3, 0.3), depth / 2 + 0.12, top, -90)
    elif draw.chance(0.4):
        parts += rim_tap(draw, 0.0, depth / 2 - wall / 2, top - 0.01, -90)
    return parts


def built_in(draw: Draw) -> list[Mesh]:
    """A rectangular tub with a flat rim and an apron, plain, ribbed or with a sunk panel."""
    width, depth, top = draw.between(1.4, 1.85), draw.between(0.68, 0.85), draw.between(0.42, 0.6)
    rim, end, floor = draw.between(0.05, 0.1), draw.pick(-1, 1), draw.between(0.08, 0.14)
    radius, lip = draw.between(0.12, 0.3), draw.between(0.03, 0.06)
    square, inside = rounded_outline(0.012), rounded_outline(radius)
    inset = draw.between(0.0, 0.04)
    outer = [
        ring_at(square(width - 2 * inset, depth - 2 * inset), 0.0),
        ring_at(square(width - 2 * inset, depth - 2 * inset), top - lip),
        ring_at(square(width, depth), top - lip),
        ring_at(square(width, depth), top - 0.008),
        ring_at(square(width - 0.016, depth - 0.016), top),
    ]
    head = draw.between(0.0, 0.08)  # a wider ledge at the tap end
    hollow = hollow_rings(draw, inside, (width - 2 * rim - head, depth - 2 * rim), floor, top, end)
    hollow = [ring - (end * head / 2, 0, 0) for ring in hollow]
    parts = [vessel(outer, hollow), *fittings(draw, width - head, floor, top, end)]
    front = inset - depth / 2
    kind = draw.pick("plain", "plain", "panel", "ribs", "curved")
    if kind == "panel":
        size = (0.85 * width, 0.03, top - lip - 0.12)
        parts.append(rounded_box(size, (0, front, 0.06), radius=0.012, steps=1))
    elif kind == "ribs":
        for k in range(12):
            at = ((width - 0.1) * (k / 11 - 0.5), front, 0.0)
            parts.append(box((0.05, 0.02, top - lip), at))
    elif kind == "curved":
        x = np.linspace(-1, 1, 15)
        half = width / 2 - inset
        bow = np.stack([x * half, front - 0.07 * (1 - x**2)], axis=1)
        ends = [(half, front + 0.03), (-half, front + 0.03)]
        parts.append(slab(np.concatenate([bow, ends]), top - lip))
    if draw.chance(0.3):  # tiled walls' ledge behind and at an end
        parts.append(box((width, 0.03, top + 0.08), (0, depth / 2 + 0.015, 0)))
    if draw.chance(0.65):
        parts += rim_tap(draw, end * (width / 2 - rim / 2 - head / 2), 0, top, 90 + 90 * end)
    return parts


def claw_foot(draw: Draw) -> list[Mesh]:
    """A cast-iron tub with a rolled rim on four claw feet, its taps at the end or the side."""
    width, depth, top = draw.between(1.4, 1.8), draw.between(0.7, 0.82), draw.between(0.54, 0.64)
    lift, end = draw.between(0.1, 0.17), draw.pick(-1, 1)
    parts = [bowl(draw, oval_outline(draw.between(2.2, 3.4)), width, depth, lift, top, end)]
    parts += claw_feet(draw, width, depth, lift) + fittings(draw, width, lift + 0.03, top, end)
    kind = draw.pick("rim", "floor", "none", "shower")
    if kind == "rim":
        parts += rim_tap(draw, end * (width / 2 - 0.04), 0, top + 0.015, 90 + 90 * end)
    elif kind == "floor":
        parts += floor_tap(draw, end * (width / 2 + 0.1), 0, top, 90 + 90 * end)
    elif kind == "shower":  # a riser with a rose over the tub
        x, tall = end * (width / 2 + 0.05), draw.between(1.7, 2.0)
        path = np.concatenate(
            [[(x, 0, 0)], arc((x, 0, tall - 0.15), (x, 0, tall), (x - end * 0.35, 0, tall), 6)]
        )
        parts.append(tube(path, 0.014))
        parts.append(lathe([(0.02, 0.05), (0.1, 0.02), (0.1, 0)], (x - end * 0.35, 0, tall - 0.05)))
        parts.append(rod((x, 0, top + 0.08), (x - end * 0.14, 0, top + 0.08), 0.016))
    return parts


def monoblock(draw: Draw) -> list[Mesh]:
    """A modern block with round or sharp corners and walls that are thick all the way down."""
    width, depth, top = draw.between(1.5, 1.9), draw.between(0.7, 0.95), draw.between(0.48, 0.62)
    wall, floor, end = draw.between(0.03, 0.12), draw.between(0.09, 0.16), draw.pick(-1, 0, 1)
    radius, foot = draw.pick(0.02, draw.between(0.08, 0.36)), draw.between(0.86, 1.0)
    outline, inside = rounded_outline(radius), rounded_outline(max(0.1, radius - 0.3 * wall))
    outer = []
    for t in (0.0, 0.03, 0.97, 1.0):
        s = foot + (1 - foot) * t
        cut = 0.012 if t in (0.0, 1.0) else 0.0
        outer.append(ring_at(outline(width * s - cut, depth * s - cut), top * t))
    hollow = hollow_rings(draw, inside, (width - 2 * wall, depth - 2 * wall), floor, top, end)
    parts = [vessel(outer, hollow), *fittings(draw, width, floor, top, end or 1)]
    if draw.chance(0.5):
        parts += floor_tap(draw, draw.between(-0.4, 0.4), depth / 2 + 0.1, top, -90)
    elif wall > 0.06:
        parts += rim_tap(draw, 0.0, depth / 2 - wall / 2, top, -90)
    return parts


def drop_in(draw: Draw) -> list[Mesh]:
    """A tub let into a wide deck, with its rim on it, taps behind and often a step before it."""
    width, depth, deck = draw.between(1.7, 2.1), draw.between(0.95, 1.25), draw.between(0.4, 0.58)
    outline, end = oval_outline(draw.between(2.2, 4.0)), draw.pick(-1, 0, 1)
    w, d = width - draw.between(0.2, 0.4), depth - draw.between(0.22, 0.4)
    y, lip, rise = draw.between(-0.04, 0.0), draw.between(0.04, 0.07), draw.between(0.015, 0.04)
    # the same parameter along both curves keeps the deck's triangles tidy
    unit = oval_outline(2.0)(2, 2)
    square = unit / np.abs(unit).max(axis=1, keepdims=True) * (width / 2, depth / 2)
    outer = [ring_at(square, z) for z in (0.0, deck)]
    offset = np.array([0, y, 0])
    for grow, z in ((lip, deck), (lip, deck + 0.6 * rise), (0.6 * lip, deck + rise)):
        curve = outline(w + 2 * grow, d + 2 * grow)
        outer.append(ring_at(curve, z) + offset)
    hollow = [ring + offset for ring in hollow_rings(draw, outline, (w, d), 0.1, deck + rise, end)]
    parts = [vessel(outer, hollow), *fittings(draw, w, 0.1, deck, end or 1)]
    if draw.chance(0.5):
        step = (width * draw.between(0.5, 1.0), 0.3, draw.between(0.15, 0.22))
        parts.append(box(step, (0, -depth / 2 - 0.15, 0)))
    if draw.chance(0.4):
        for k in range(1, 4):  # panels of the apron
            at = (width * (k / 4 - 0.5), -depth / 2, 0.05)
            parts.append(box((width / 4 - 0.06, 0.024, deck - 0.1), at))
    if draw.chance(0.7):
        parts += rim_tap(draw, draw.between(-0.3, 0.3) * width, depth / 2 - 0.06, deck, -90)
    return parts


def slipper(draw: Draw) -> list[Mesh]:
    """A tub raised at one end or both, on claw feet or a plinth."""
    width, depth, top = draw.between(1.5, 1.8), draw.between(0.68, 0.8), draw.between(0.52, 0.6)
    raised, double, lift = draw.between(0.14, 0.28), draw.chance(0.35), draw.between(0.1, 0.16)
    end = draw.pick(-1, 1)
    tub = bowl(draw, oval_outline(draw.between(2.0, 2.8)), width, depth, lift, top, 0.0, wall=0.04)
    v = tub.vertices
    u = v[:, 0] / (width / 2)
    along = np.abs(u) if double else np.clip(-end * u + 0.35, 0, None) / 1.35
    height = np.clip((v[:, 2] - lift) / (top - lift), 0, None)
    lean = 0.1 * np.sign(u) * along**2 * height  # the raised end also leans out
    shape = np.stack([v[:, 0] + lean, v[:, 1], v[:, 2] + raised * along**2 * height**2], axis=1)
    parts = [Mesh(shape, tub.faces), *fittings(draw, 0.9 * width, lift + 0.03, top, end)]
    if draw.chance(0.5):
        parts += claw_feet(draw, width, depth, lift)
    else:
        base = [(0.37, 0), (0.37, 0.05), (0.33, 0.08), (0.33, lift + 0.06)]
        outline = oval_outline(2.4)
        rings = [ring_at(outline(2 * s * width, 1.9 * s * depth), z) for s, z in base]
        parts.append(loft(np.stack(rings)))
    if draw.chance(0.5):
        parts += floor_tap(draw, 0.0, depth / 2 + 0.1, top, -90)
    return parts


def corner(draw: Draw) -> list[Mesh]:
    """A tub for the corner of a room: a quarter round or a cut square, with an oval hollow."""
    reach, top = draw.between(1.2, 1.55), draw.between(0.45, 0.62)
    cut, floor = draw.pick("round", "straight"), draw.between(0.1, 0.15)
    angle = np.unique(np.concatenate([np.arange(48) * (2 * np.pi / 48), np.pi * np.array([0.25])]))
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # from a centre near the middle, the distance to the two walls and to the front
    back, low = 0.44 * reach, -0.56 * reach
    far = np.full(len(angle), np.inf)
    for axis in (0, 1):
        for limit in (back, low):
            along = ray[:, axis] * np.sign(limit)
            hit = np.where(along > 1e-9, abs(limit) / np.maximum(along, 1e-9), np.inf)
            far = np.minimum(far, hit)
    if cut == "round":
        centre = np.array([back, back])
        b = ray @ centre
        far = np.minimum(far, b + np.sqrt(b**2 - centre @ centre + (1.02 * reach) ** 2))
    else:
        along = -(ray @ np.array([1, 1])) / np.sqrt(2)
        limit = draw.between(0.36, 0.48) * reach
        far = np.minimum(far, np.where(along > 1e-9, limit / np.maximum(along, 1e-9), np.inf))
    curve = ray * far[:, None]
    lip, rim = draw.between(0.03, 0.06), draw.between(0.06, 0.12)
    outer = [
        ring_at(curve * s, z) for s, z in ((0.95, 0), (0.95, top - lip), (1, top - lip), (1, top))
    ]
    # the hollow is an ellipse across the diagonal, blended with the outline
    diagonal = np.stack([(ray @ [1, -1]), (ray @ [1, 1])], axis=1) / np.sqrt(2)
    wide, deep = 0.58 * reach, 0.38 * reach
    oval = 1 / np.sqrt((diagonal[:, 0] / wide) ** 2 + (diagonal[:, 1] / deep) ** 2)
    blend = draw.between(0.4, 1.0)
    opening = np.minimum(blend * oval + (1 - blend) * far, far - rim)[:, None] * ray
    levels = [(1, top), (0.97, top - 0.03), (0.9, 0.5 * top), (0.78, floor + 0.06), (0.6, floor)]
    parts = [vessel(outer, [ring_at(opening * s, z) for s, z in levels])]
    parts.append(cylinder(0.03, 0.008, (0, 0, floor), sides=14))
    if draw.chance(0.6):
        parts += rim_tap(draw, back - 0.14, back - 0.14, top, 225)
    if draw.chance(0.4):  # a seat in the back corner
        parts.append(rounded_box((0.3, 0.3, 0.04), (back - 0.16, back - 0.16, top - 0.02)))
    return [turn(p, 45) for p in parts]


def barrel(draw: Draw) -> list[Mesh]:
    """A deep soaking tub of staves, round or oval, with hoops, a bench inside, a step outside."""
    depth, top = draw.between(0.75, 1.2), draw.between(0.6, 0.85)
    width, foot = depth * draw.pick(1.0, draw.between(1.2, 1.6)), draw.between(0.86, 1.0)
    wall, floor, staves = draw.between(0.03, 0.05), draw.between(0.08, 0.15), draw.count(20, 30)
    angle = np.arange(3 * staves) * (2 * np.pi / (3 * staves))
    groove = np.where(np.arange(3 * staves) % 3 == 0, 0.985, 1.0)[:, None]
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    half = np.array([width, depth]) / 2
    outer = [
        ring_at(circle * groove * half * (foot + (1 - foot) * t), top * t) for t in (0.0, 0.5, 1.0)
    ]
    inside = [(1, top), (0.5 + foot / 2, (top + floor) / 2), (foot, floor)]
    parts = [vessel(outer, [ring_at(circle * (half - wall) * s, z) for s, z in inside])]
    for t in (0.15, 0.8):
        s = foot + (1 - foot) * t
        band = [circle * (half * s + g) for g in (-0.01, 0.008)]
        z, tall = top * t, 0.035
        rings = [(band[0], z), (band[1], z), (band[1], z + tall), (band[0], z + tall)]
        parts.append(loft(np.stack([ring_at(c, h) for c, h in rings]), loop=True))
    if draw.chance(0.6):
        parts.append(box((0.2 * width, 0.45 * depth, 0.04), (0.25 * width, 0, 0.45 * top)))
    if draw.chance(0.6):
        step, rise = draw.between(0.4, 0.6), draw.between(0.18, 0.25)
        parts.append(box((step, 0.5, rise), (0, -depth / 2 - 0.2, 0)))
        parts.append(box((step, 0.25, 2 * rise), (0, -depth / 2 - 0.08, 0)))
    if draw.chance(0.4):
        parts += floor_tap(draw, 0.0, depth / 2 + 0.1, top, -90)
    return parts


FAMILIES: tuple[Family, ...] = (
    train(freestanding),
    train(built_in),
    train(claw_foot),
    train(monoblock),
    train(drop_in),
    test(slipper),
    test(corner),
    test(barrel),
)
