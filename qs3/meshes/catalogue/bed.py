"""Beds: platforms, box springs, four-posters, cribs, sleighs, iron beds, bunks, daybeds, futons."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.bed_parts import bedding, board, cover
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.joinery import Look, any_look, drawer
from qs3.meshes.catalogue.parts import (
    arc,
    beam,
    box,
    cylinder,
    ellipsoid,
    extrude,
    frustum,
    lathe,
    loft,
    move,
    pillow,
    rod,
    rounded_box,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh


def _size(draw: Draw) -> tuple[float, float]:
    """Width and length of a mattress."""
    return draw.pick(0.9, 1.0, 1.2, 1.4, 1.6, 1.8) + draw.between(-0.03, 0.03), draw.between(
        1.9, 2.1
    )


def platform(draw: Draw) -> list[Mesh]:
    """A low frame with mattress and headboard, on legs, on a plinth or over drawers."""
    (width, length), thick = _size(draw), draw.between(0.16, 0.28)
    deck, rim, rail = draw.between(0.2, 0.36), draw.between(0.02, 0.1), draw.between(0.1, 0.18)
    w, long = width + 2 * rim, length + rim
    kind = draw.pick("legs", "legs", "plinth", "drawers")
    parts = [box((w, long, deck - 0.02 if kind == "drawers" else rail), (0, 0, 0))]
    if kind != "drawers":
        parts[0] = move(parts[0], (0, 0, deck - rail))
    if kind == "legs":
        for x in (-w / 2 + 0.07, w / 2 - 0.07):
            for y in (-long / 2 + 0.07, long / 2 - 0.07):
                parts.append(frustum((0.04, 0.04), (0.07, 0.07), deck - rail, (x, y, 0)))
    elif kind == "plinth":
        parts.append(box((0.75 * w, 0.85 * long, deck - rail), (0, 0, 0)))
    else:
        look = any_look(draw, "flat", "framed")
        for s in (-90, 90):
            for y in (-0.25 * long, 0.25 * long):
                pulled = draw.between(0.1, 0.35) if draw.chance(0.1) else 0.0
                fronts = drawer(look, 0.48 * long, deck - 0.06, 0.45, (0, 0, 0.02), pulled=pulled)
                parts += [move(turn(p, s), (w / 2 * s / 90, y, 0)) for p in fronts]
    parts += board(draw, w + draw.pick(0.0, 0.0, 0.5), long / 2, draw.between(0.75, 1.2))
    return parts + bedding(draw, width, length, deck - 0.03, thick)


def box_spring(draw: Draw) -> list[Mesh]:
    """A tall upholstered bed: base, mattress, topper, padded headboard."""
    (width, length), base = _size(draw), draw.between(0.26, 0.36)
    lift, thick = draw.between(0.04, 0.12), draw.between(0.2, 0.28)
    parts = []
    for x in (-width / 2 + 0.08, width / 2 - 0.08):
        for y in (-length / 2 + 0.08, length / 2 - 0.08):
            parts.append(cylinder(0.03, lift + 0.02, (x, y, 0), top=0.035, sides=10))
    halves = 2 if width > 1.5 else 1
    for k in range(halves):
        at = (width * ((k + 0.5) / halves - 0.5), 0, lift)
        parts.append(rounded_box((width / halves, length, base), at, radius=0.03))
    kinds = ("padded", "padded", "winged", "panel")
    parts += board(draw, width + draw.pick(0.0, 0.1), length / 2, draw.between(0.95, 1.4), *kinds)
    if draw.chance(0.2):  # a bench at the foot
        bench = (0.8 * width, 0.4, draw.between(0.4, 0.5))
        parts.append(rounded_box(bench, (0, -length / 2 - 0.25, 0), radius=0.04))
    return parts + bedding(draw, width, length, lift + base - 0.01, thick)


def four_poster(draw: Draw) -> list[Mesh]:
    """Four tall posts, joined at the top; sometimes a canopy or curtains."""
    (width, length), tall = _size(draw), draw.between(1.8, 2.2)
    post, deck, w, long = (
        draw.between(0.05, 0.09),
        draw.between(0.3, 0.42),
        width + 0.1,
        length + 0.1,
    )
    turned, top, x, y = (
        draw.chance(0.5),
        draw.pick("rails", "rails", "cloth", "none"),
        w / 2,
        long / 2,
    )
    corners = [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]
    parts = []
    r = post / 2
    profile = [(1.2, 0), (1.2, 0.3), (0.7, 0.33), (1.1, 0.42), (0.6, 0.6), (0.9, 0.8), (0.6, 0.97)]
    for px, py in corners:
        if turned:
            parts.append(lathe([(s * r, t * tall) for s, t in profile], (px, py, 0), sides=12))
            parts.append(ellipsoid((post, post, 1.4 * post), (px, py, tall), sides=10, rings=5))
        else:
            parts.append(box((post, post, tall), (px, py, 0)))
    for s in (-1, 1):
        parts.append(box((0.04, long, 0.16), (s * x, 0, deck - 0.12)))
        parts.append(box((w, 0.04, 0.16), (0, s * y, deck - 0.12)))
        if top != "none":
            parts.append(box((0.04, long, 0.04), (s * x, 0, 0.96 * tall)))
            parts.append(box((w, 0.04, 0.04), (0, s * y, 0.96 * tall)))
    if top == "cloth":
        roof = cover(draw, w + 0.08, 0.88 * tall, 0.99 * tall, -y - 0.04, y + 0.04)
        parts.append(roof if draw.chance(0.6) else box((w, long, 0.02), (0, 0, 0.97 * tall)))
    if top != "none" and draw.chance(0.4):  # curtains drawn back to the posts
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        curve = (0.09 + 0.025 * np.cos(8 * angle))[:, None] * np.stack(
            [np.cos(angle), np.sin(angle)], axis=1
        )
        for px, py in corners:
            shape = [(1.0, 0.05), (0.85, 0.3), (0.55, 0.55), (1.0, 0.96)]
            rings = [np.column_stack([s * curve, np.full(40, t * tall)]) for s, t in shape]
            parts.append(move(loft(np.stack(rings)), (0.97 * px, 0.97 * py, 0)))
    parts += board(draw, w, y - 0.02, draw.between(0.9, 1.3), "panel", "slats", "arch", "framed")
    return parts + bedding(draw, width, length, deck - 0.04, draw.between(0.2, 0.28))


def crib(draw: Draw) -> list[Mesh]:
    """A baby's cot: bars or panels all round, a small mattress, sometimes one side lowered."""
    width, length, tall = draw.between(0.62, 0.78), draw.between(1.2, 1.45), draw.between(0.8, 1.05)
    low, deck, post = draw.between(0.12, 0.25), draw.between(0.28, 0.5), draw.between(0.035, 0.055)
    pitch, front = draw.between(0.07, 0.095), tall - draw.pick(0.0, 0.0, 0.2)
    solid, x, y = draw.chance(0.35), width / 2, length / 2
    parts = [box((post, post, tall), (sx * x, sy * y, 0)) for sx in (-1, 1) for sy in (-1, 1)]

    def bars(p: tuple[float, float], q: tuple[float, float], top: float) -> list[Mesh]:
        made = [beam((*p, z), (*q, z), (0.025, 0.05)) for z in (low, top - 0.03)]
        count = int(np.hypot(q[0] - p[0], q[1] - p[1]) / pitch)
        for k in range(1, count):
            x, y = (a + (b - a) * k / count for a, b in zip(p, q, strict=True))
            made.append(rod((x, y, low), (x, y, top - 0.03), 0.009, sides=6))
        return made

    for s in (-1, 1):
        parts += bars((s * x, -y), (s * x, y), front if s > 0 else tall)
        if solid:
            head = tall + draw.between(0.0, 0.15)
            parts.append(box((width, 0.025, head - low), (0, s * y, low)))
        else:
            parts += bars((-x, s * y), (x, s * y), tall)
    size = (width - 0.03, length - 0.03, draw.between(0.1, 0.14))
    parts.append(rounded_box(size, (0, 0, deck), radius=0.03))
    parts.append(box((width - 0.02, length - 0.02, 0.02), (0, 0, deck - 0.02)))
    z = deck + size[2]
    if draw.chance(0.6):
        parts.append(cover(draw, width - 0.04, deck, z, -y + 0.03, draw.between(0.0, 0.2) * length))
    if draw.chance(0.6):
        parts.append(pillow((0.4, 0.28, 0.07), (0, y - 0.2, z)))
    return parts


def sleigh(draw: Draw) -> list[Mesh]:
    """A head- and a footboard that roll outwards like a sleigh, joined by deep side rails."""
    (width, length), thick = _size(draw), draw.between(0.2, 0.28)
    deck, w, tall = draw.between(0.28, 0.38), width + 0.08, draw.between(1.0, 1.3)
    foot, thin = tall * draw.between(0.55, 0.8), draw.between(0.035, 0.06)
    parts = []
    for side, top in ((1, tall), (-1, foot)):
        roll = draw.between(0.12, 0.25)
        spine = arc((0, 0, 0.08), (0, -0.02, 0.6 * top), (0, roll, top - 0.04), 12)[:, 1:]
        spine[:, 0] += length / 2 + thin / 2
        normal = np.gradient(spine, axis=0)[:, ::-1] * (1, -1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        outline = np.concatenate([spine + normal * thin / 2, (spine - normal * thin / 2)[::-1]])
        outline[:, 0] *= side
        parts.append(move(extrude(outline, w, "x"), (-w / 2, 0, 0)))
        tip = (side * spine[-1, 0], spine[-1, 1])
        parts.append(rod((-w / 2, *tip), (w / 2, *tip), 0.9 * thin + 0.015, sides=14))
        for s in (-1, 1):
            at = (s * (w / 2 - 0.05), side * (length / 2 + thin / 2), 0)
            parts.append(box((0.08, 0.08, 0.12), at))
    for s in (-1, 1):
        rail = (0.04, length + thin, draw.between(0.16, 0.24))
        parts.append(box(rail, (s * (w / 2 - 0.02), 0, deck - 0.12)))
    parts.append(box((width, length, 0.03), (0, 0, deck - 0.06)))
    return parts + bedding(draw, width, length, deck - 0.03, thick)


def iron(draw: Draw) -> list[Mesh]:
    """A bed of metal tubes: hooped or straight head and foot with upright bars."""
    (width, length), deck = _size(draw), draw.between(0.32, 0.45)
    tall, r, hooped = draw.between(0.9, 1.25), draw.between(0.014, 0.024), draw.chance(0.6)
    w, pitch, parts = width + 0.06, draw.between(0.1, 0.2), []
    for side, top in ((1, tall), (-1, tall * draw.between(0.5, 0.85))):
        y, rise = side * (length / 2 + 0.03), (draw.between(0.1, 0.3) if hooped else 0.0)
        for s in (-1, 1):
            parts.append(rod((s * w / 2, y, 0), (s * w / 2, y, top - rise), r))
            parts.append(
                ellipsoid((4 * r, 4 * r, 4 * r), (s * w / 2, y, top - rise), sides=10, rings=5)
            )
        ends = (-w / 2, y, top - rise), (w / 2, y, top - rise)
        parts.append(tube(arc(ends[0], (0, y, top + rise), ends[1], 14), r))
        parts.append(rod((-w / 2, y, deck), (w / 2, y, deck), r))
        if draw.chance(0.5):
            z = deck + 0.6 * (top - rise - deck)
            parts.append(rod((-w / 2, y, z), (w / 2, y, z), 0.7 * r))
        count = int(w / pitch)
        for k in range(1, count):
            u = 2 * k / count - 1
            parts.append(
                rod((u * w / 2, y, deck), (u * w / 2, y, top - rise * u * u), 0.5 * r, sides=6)
            )
    for s in (-1, 1):
        parts.append(box((0.03, length + 0.06, 0.04), (s * w / 2, 0, deck - 0.03)))
    parts.append(box((w, length, 0.015), (0, 0, deck - 0.02)))
    return parts + bedding(draw, width, length, deck - 0.005, draw.between(0.16, 0.25))


def bunk(draw: Draw) -> list[Mesh]:
    """Two beds over each other, or a loft bed over a desk, with guard rails and a ladder."""
    width, length, tall = draw.between(0.8, 1.0), draw.between(1.9, 2.05), draw.between(1.5, 1.8)
    post, high, low = (
        draw.between(0.05, 0.09),
        draw.between(0.7, 0.78) * tall,
        draw.between(0.22, 0.4),
    )
    x, y, thick = width / 2 + post / 2, length / 2 + post / 2, draw.between(0.12, 0.18)
    loft_bed = draw.chance(0.25)
    parts = [box((post, post, tall), (sx * x, sy * y, 0)) for sx in (-1, 1) for sy in (-1, 1)]
    for level in [high] if loft_bed else [low, high]:
        for s in (-1, 1):
            parts.append(box((0.03, 2 * y, 0.14), (s * x, 0, level - 0.09)))
            parts.append(box((2 * x, 0.03, 0.14), (0, s * y, level - 0.09)))
        parts.append(box((width, length, 0.02), (0, 0, level - 0.02)))
        parts += bedding(draw, width, length, level, thick)
        for s in (-1, 1):
            for z in np.linspace(level + 0.22, min(level + 0.5, tall - 0.06), draw.count(1, 3)):
                parts.append(box((2 * x, 0.022, 0.08), (0, s * y, float(z) - 0.04)))
    rails = np.linspace(high + 0.16, tall - 0.08, 2)
    for z in rails:
        parts.append(box((0.022, 2 * y, 0.07), (-x, 0, float(z))))
        parts.append(box((0.022, 1.4 * y, 0.07), (x, 0.3 * y, float(z))))
    slope, rung = draw.pick(0.0, 0.0, 0.3), draw.between(0.28, 0.4)
    for s in (-1, 1):
        at = (x + slope + 0.03, -0.7 * y + s * rung / 2, 0)
        parts.append(frustum((0.05, 0.03), (0.05, 0.03), tall - 0.05, at, (-slope, 0)))
    count = draw.count(4, 6)
    for k in range(1, count + 1):
        z = high * k / (count + 0.5)
        step = (x + 0.03 + slope * (1 - z / (tall - 0.05)), -0.7 * y, z)
        parts.append(box((0.06, rung, 0.03), step))
    if loft_bed:
        parts.append(box((0.6, 1.2, 0.03), (-0.15, 0.2, 0.72)))
        parts += [box((0.55, 0.04, 0.72), (-0.15, v, 0)) for v in (-0.38, 0.78)]
    return parts


def daybed(draw: Draw) -> list[Mesh]:
    """A single bed along a wall with back and two ends, half a sofa; perhaps a trundle below."""
    length, depth, deck = draw.between(1.9, 2.1), draw.between(0.85, 1.0), draw.between(0.3, 0.4)
    ends, back, thick = draw.between(0.6, 0.95), draw.between(0.7, 1.05), draw.between(0.14, 0.22)
    kinds = (draw.pick("slats", "padded", "panel", "framed"),)
    parts = board(draw, length + 0.08, depth / 2, back, *kinds) if draw.chance(0.85) else []
    for s in (-90, 90):
        parts += [
            move(turn(p, s), (-s / 90 * length / 2, 0, 0))
            for p in board(draw, depth, 0, ends, *kinds)
        ]
    parts.append(box((length, depth, 0.12), (0, 0, deck - 0.12)))
    if draw.chance(0.4):
        look = Look("flat", draw.pick("bar", "knob", "cup"), 1.1)
        for k in (-1, 1):
            at = (k * length / 4, -depth / 2 + 0.02, 0.03)
            parts += drawer(look, 0.48 * length, deck - 0.16, 0.6, at, grips=2)
    z = deck + thick
    parts.append(rounded_box((length, depth, thick), (0, 0, deck), radius=0.05, crown=0.01))
    for k in range(draw.count(1, 4)):
        body = turn(move(pillow((0.5, 0.48, 0.18)), (0, 0, -0.09)), draw.between(60, 78), "x")
        parts.append(move(body, (0.52 * k - 0.75, depth / 2 - 0.16, z + 0.23)))
    if draw.chance(0.5):
        body = move(pillow((0.42, 0.66, 0.15)), (0, 0, -0.075))
        parts.append(move(turn(body, -18, "y"), (length / 2 - 0.3, -0.06, z + 0.13)))
    if draw.chance(0.5):
        throw = turn(cover(draw, depth + 0.02, z - 0.15, z, 0.0, draw.between(0.5, 1.1)), 90)
        parts.append(move(throw, (draw.between(0.0, 0.2), -0.01, 0)))
    return parts


def futon(draw: Draw) -> list[Mesh]:
    """A thick mat on the floor, on slats or on pallets, without a headboard."""
    width, length = draw.pick(0.9, 1.2, 1.4, 1.6), draw.between(1.9, 2.1)
    thick, base = draw.between(0.1, 0.22), draw.pick("floor", "slats", "pallets", "mat")
    parts, z = [], 0.0
    if base == "slats":
        z, out = draw.between(0.08, 0.2), draw.between(0.0, 0.15)
        for x in (-0.42 * width, 0.0, 0.42 * width):
            parts.append(box((0.06, length + out, z - 0.02), (x, 0, 0)))
        for k in range(14):
            at = (0, (length + out - 0.08) * (k / 13 - 0.5), z - 0.02)
            parts.append(box((width + out, 0.08, 0.02), at))
    elif base == "pallets":
        z = 0.145
        for y in (-length / 4, length / 4):
            for k in range(7):
                x = (width + 0.06) * (k / 6 - 0.5)
                parts.append(box((0.1, length / 2 - 0.01, 0.022), (x, y, z - 0.022)))
            for row in (-0.2, 0.0, 0.2):
                at = (0, y + row * length, 0.0)
                parts.append(box((width + 0.16, 0.1, 0.124), at))
    elif base == "mat":
        z = 0.05
        parts.append(box((width + 0.5, length + 0.3, z), (0, 0, 0)))
    if draw.chance(0.3):
        parts.append(rounded_box((width + 0.02, length, 0.12), (0, 0, z), radius=0.04))
        z += 0.11
    return parts + bedding(draw, width, length, z, thick, upright=False)


FAMILIES: tuple[Family, ...] = (
    train(platform),
    train(box_spring),
    train(four_poster),
    train(crib),
    train(sleigh),
    train(iron),
    test(bunk),
    test(daybed),
    test(futon),
)
