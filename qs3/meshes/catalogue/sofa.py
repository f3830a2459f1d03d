"""Sofas: cushioned, L-shaped, buttoned, wooden, curved, convertible; front along -y."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue import parts as p
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.furniture import (
    back_cushion,
    back_cushions,
    both_sides,
    four_legs,
    leg_section,
    post,
    scatter,
    seat_cushions,
    sofa_size,
)
from qs3.meshes.mesh import Mesh


def feet(draw: Draw, width: float, depth: float, height: float) -> list[Mesh]:
    """Legs near the corners, a third pair under a long sofa, or a recessed plinth when low."""
    if height < 0.05:
        return [p.box((width - 0.1, depth - 0.1, height + 0.01), (0, 0, 0))]
    section = leg_section(draw.chance(0.5), draw.between(0.04, 0.07))
    out = four_legs(width - 0.16, depth - 0.16, height + 0.01, section, foot=draw.between(0.5, 1.0))
    if width > 1.9:
        y = depth / 2 - 0.08
        out += [post([(0, s * y, 0), (0, s * y, height + 0.01)], section) for s in (-1, 1)]
    return out


def cushioned(draw: Draw) -> list[Mesh]:
    """The common sofa: box arms, two or three seat cushions and as many for the back."""
    size = sofa_size(draw, draw.pick(2, 2, 3, 3))
    y, shell = size.depth / 2, draw.between(0.10, 0.16)
    thick, rear = draw.between(0.12, 0.18), y - shell
    deck = size.seat - thick
    out = feet(draw, size.width, size.depth, size.foot)
    out.append(
        p.rounded_box(
            (size.width - 0.02, size.depth - 0.02, deck - size.foot), (0, 0, size.foot), 0.02
        )
    )
    arm = (size.arm, size.depth, size.rest - size.foot)
    at = (size.inside / 2 + size.arm / 2, 0, size.foot)
    out += both_sides(p.rounded_box(arm, at, draw.between(0.02, 0.08)))
    back = (size.inside + 0.02, shell, size.top - 0.04 - size.foot)
    out.append(p.rounded_box(back, (0, y - shell / 2, size.foot), 0.04))
    cushion = draw.between(0.12, 0.18)
    out += seat_cushions(size, thick, -y - 0.01, rear)
    out += back_cushions(draw, size, cushion, rear - 0.03, draw.between(4, 12))
    return out + scatter(draw, size, rear - cushion)


def loveseat(draw: Draw) -> list[Mesh]:
    """A small sofa with a tight back, one seat cushion and slender tapered legs."""
    size = sofa_size(draw, draw.pick(1, 2, 2))
    y, foot = size.depth / 2 - 0.04, draw.between(0.12, 0.2)
    arm, rake = draw.between(0.08, 0.14), draw.between(6, 13)
    width = size.inside + 2 * arm
    section = leg_section(True, draw.between(0.035, 0.05))
    out = four_legs(width - 0.2, 2 * y - 0.16, foot + 0.01, section, splay=0.04, foot=0.5)
    deck = size.seat - draw.between(0.10, 0.15)
    out.append(p.rounded_box((width - 0.02, 2 * y, deck - foot), (0, 0, foot), 0.03))
    out.append(
        p.rounded_box((size.inside, 2 * y - 0.1, size.seat - deck), (0, -0.05, deck), 0.04, 0.02)
    )
    back = (width - arm * draw.pick(0.0, 1.4), 0.13, size.top - foot)
    out.append(back_cushion(back, (0, y, foot), rake=rake, crown=0.03, radius=0.05))
    lean = draw.between(-8, 0)
    side = p.rounded_box((arm, 2 * y - 0.04, size.rest - foot), (0, 0.01, 0), 0.45 * arm)
    return out + both_sides(p.move(p.turn(side, -lean, "y"), (width / 2 - arm / 2, 0, foot)))


def chaise(draw: Draw) -> list[Mesh]:
    """A sofa whose last seat is drawn out to lie on: an L, to the left or to the right."""
    size = sofa_size(draw, 3)
    y, shell = size.depth / 2, draw.between(0.12, 0.2)
    reach, thick = draw.between(0.55, 0.85), draw.between(0.13, 0.18)
    deck, rear, wide = size.seat - thick, y - shell, size.inside / 3
    out = feet(draw, size.width, size.depth, size.foot)
    out.append(
        p.rounded_box((size.width, size.depth - 0.02, deck - size.foot), (0, 0, size.foot), 0.02)
    )
    x, end = size.inside / 2 - wide / 2 + size.arm / 2, -y - reach
    long = (wide + size.arm, reach + 0.1, deck - size.foot)
    out.append(p.rounded_box(long, (x, (end - y + 0.1) / 2, size.foot), 0.02))
    out.append(p.box((0.06, 0.06, size.foot + 0.01), (x + 0.4 * wide, end + 0.08, 0)))
    out.append(p.box((0.06, 0.06, size.foot + 0.01), (x - 0.4 * wide, end + 0.08, 0)))
    cushion = (wide + size.arm - 0.006, rear - end, thick)
    out.append(p.rounded_box(cushion, (x, (end + rear) / 2, deck), 0.04, 0.02))
    out += seat_cushions(size, thick, -y, rear)[:2]
    at = (-size.inside / 2 - size.arm / 2, 0, size.foot)
    out.append(p.rounded_box((size.arm, size.depth, size.rest - size.foot), at, 0.05))
    if draw.chance(0.4):
        rest = (size.arm, 0.7 * size.depth, size.rest - size.foot)
        out.append(p.rounded_box(rest, (-at[0], 0.15 * size.depth, size.foot), 0.05))
    out.append(
        p.rounded_box(
            (size.width, shell, size.top - size.foot), (0, y - shell / 2, size.foot), 0.05
        )
    )
    out += back_cushions(draw, size, 0.15, rear - 0.02, draw.between(5, 12))
    out += scatter(draw, size, rear - 0.15)
    return out if draw.chance(0.5) else [p.mirrored(part) for part in out]


def roll(length: float, radius: float) -> Mesh:
    """A padded roll along y with rounded ends, about the origin."""
    t = np.array([-0.5, -0.49, -0.46, 0.46, 0.49, 0.5])
    path = np.column_stack([0 * t, t * length, 0 * t])
    return p.tube(path, radius, scale=[0.7, 0.92, 1, 1, 0.92, 0.7], sides=18)


def chesterfield(draw: Draw) -> list[Mesh]:
    """Arms and back are one buttoned roll of equal height; low feet."""
    size = sofa_size(draw, draw.count(2, 3))
    radius, foot = draw.between(0.075, 0.11), draw.between(0.06, 0.11)
    top, y = draw.between(0.70, 0.80), size.depth / 2
    x, thick = size.inside / 2 + radius, draw.between(0.12, 0.16)
    out = feet(draw, 2 * x + radius, size.depth, foot)
    deck = size.seat - thick
    out.append(p.rounded_box((2 * x, size.depth - 0.05, deck - foot), (0, 0, foot), 0.03))
    out += seat_cushions(size, thick, -y - 0.01, y - 0.18)
    wall = 1.5 * radius
    arm = p.rounded_box((wall, size.depth - 0.04, top - radius - foot), (x, 0, foot), 0.03)
    out += both_sides(arm)
    out += both_sides(p.move(roll(size.depth + 0.02, radius), (x + 0.02, 0, top - radius)))
    back_wall = (2 * x, wall + 0.04, top - radius - foot)
    out.append(p.rounded_box(back_wall, (0, y - 0.1, foot), 0.03))
    across = p.turn(roll(2 * x + radius, radius), 90)
    out.append(p.move(across, (0, y - 0.07, top - radius)))
    face = y - 0.1 - (wall + 0.04) / 2
    columns = 4 * size.seats
    for row, z in enumerate((size.seat + 0.06, size.seat + 0.14, top - radius)):
        for k in range(columns - row % 2):
            bx = ((k + 0.5 + 0.5 * (row % 2)) / columns - 0.5) * size.inside
            by = face if row < 2 else y - 0.07 - radius
            out.append(p.ellipsoid((0.03, 0.025, 0.03), (bx, by, z), sides=8, rings=4))
    return out


def settee(draw: Draw) -> list[Mesh]:
    """A wooden bench with slatted back and arms, and a loose seat cushion or none."""
    width, depth = draw.between(1.15, 1.9), draw.between(0.54, 0.72)
    seat, top = draw.between(0.40, 0.45), draw.between(0.80, 0.98)
    rest, lean = seat + draw.between(0.18, 0.24), draw.between(0.05, 0.12)
    x, y, section = width / 2, depth / 2, p.rectangle(0.055, 0.055)
    out = both_sides(post([(x, -y, 0), (x, -y, rest)], section))
    out += both_sides(post([(x, y, 0), (x, y, seat), (x, y + lean, top)], section))
    out += both_sides(p.beam((x, -y - 0.05, rest), (x, y + 0.05, rest), (0.08, 0.03)))
    out.append(p.box((width - 0.02, depth, 0.06), (0, 0, seat - 0.06)))
    out += both_sides(p.beam((x, -y, 0.16), (x, y, 0.16), (0.035, 0.04)))
    low = seat + 0.1
    ends = [(-x, y + lean * (z - seat) / (top - seat), z) for z in (low, top - 0.04)]
    for left, high in zip(ends, (0.05, 0.09), strict=True):
        out.append(p.beam(left, (x, *left[1:]), (0.03, high)))
    slats = draw.count(2, 3) if draw.chance(0.35) else int(width / draw.between(0.09, 0.16))
    for k in range(slats):
        if slats > 3:  # upright
            sx = (k + 0.5) * width / slats - x
            path = [(sx, a[1], a[2]) for a in ends]
            out.append(post(path, p.rectangle(0.5 * width / slats, 0.016)))
        else:
            z = low + (k + 0.8) * (top - low - 0.06) / (slats + 0.6)
            sy = y + lean * (z - seat) / (top - seat)
            out.append(p.beam((-x, sy, z), (x, sy, z), (0.02, 0.055)))
    if draw.chance(0.6):
        thick = draw.between(0.05, 0.11)
        pads = draw.count(1, 2)
        for k in range(pads):
            at = ((k + 0.5) * (width - 0.07) / pads - (width - 0.07) / 2, -0.01, seat)
            out.append(p.rounded_box(((width - 0.08) / pads, depth - 0.03, thick), at, 0.03, 0.015))
    return out


def sofa_bed(draw: Draw) -> list[Mesh]:
    """A low folding sofa without fixed arms: two mattress halves, the back at any angle."""
    width, depth = draw.between(1.7, 2.05), draw.between(0.58, 0.72)
    seat, thick = draw.between(0.36, 0.43), draw.between(0.12, 0.18)
    foot, rise = draw.between(0.12, 0.18), draw.between(0.44, 0.56)
    rake, y = draw.pick(12.0, 15.0, 20.0, 28.0, 82.0), depth / 2
    legs = four_legs(width - 0.24, depth - 0.1, foot + 0.02, leg_section(True, 0.04), foot=0.7)
    out = [*legs, p.box((width - 0.1, depth - 0.06, seat - thick - foot), (0, 0, foot))]
    pads = draw.count(1, 3)
    for k in range(pads):
        x = (k + 0.5) * width / pads - width / 2
        out.append(
            p.rounded_box((width / pads - 0.004, depth, thick), (x, 0, seat - thick), 0.035, 0.015)
        )
        shape = (width / pads - 0.004, thick, rise)
        pad = back_cushion(shape, (0, 0, 0), rake=rake, crown=0.015, radius=0.035)
        lift = seat - 0.08 if rake < 60 else seat - float(pad.bounds[1, 2]) + 0.05
        out.append(p.move(pad, (x, y + (0.6 * thick if rake < 60 else 0.02), lift)))
    if rake > 60:
        out += [
            p.cylinder(0.02, seat - thick, (s * (width / 2 - 0.12), y + 0.4, 0)) for s in (-1, 1)
        ]
    if draw.chance(0.5):
        bolster = p.move(roll(0.9 * depth, 0.09), (width / 2 - 0.12, 0, seat + 0.08))
        out += both_sides(bolster)
    return out


def day_bed(draw: Draw) -> list[Mesh]:
    """A scroll-ended couch: one raised end, a low partial back."""
    width, depth = draw.between(1.5, 1.9), draw.between(0.66, 0.8)
    seat, foot, radius = draw.between(0.42, 0.47), draw.between(0.16, 0.22), draw.between(0.07, 0.1)
    x, top = width / 2, draw.between(0.76, 0.88)
    out = four_legs(
        width - 0.16, depth - 0.14, foot + 0.01, leg_section(True, 0.055), splay=0.02, foot=0.5
    )
    out.append(p.rounded_box((width, depth, 0.14), (0, 0, foot), 0.03))
    out.append(
        p.rounded_box(
            (width - 0.04, depth - 0.04, seat - foot - 0.12), (0, 0, foot + 0.12), 0.05, 0.03
        )
    )
    foot_end, head_end = (-x + 0.12, 0, foot + 0.08), (-x - 0.06, 0, top - radius)
    path = p.arc(foot_end, (-x + 0.05, 0, seat + 0.1), head_end)
    out.append(p.sweep(p.rounded_rectangle(depth - 0.06, 0.13, 0.04), path, up=(1, 0, 0)))
    out.append(p.move(roll(depth - 0.02, radius), (-x - 0.08, 0, top - radius)))
    long = width * draw.between(0.55, 0.8)
    fall = [(-x + 0.02, seat - 0.1), (-x + long, seat - 0.1), (-x + long - 0.05, seat + 0.03)]
    arch = p.arc(
        (-x + long - 0.15, 0, seat + 0.12),
        (-x + 0.45 * long, 0, seat + 0.2),
        (-x + 0.02, 0, top - 0.06),
    )
    plate = p.extrude([*fall, *[(a[0], a[2]) for a in arch]], 0.09, "y")
    out.append(p.move(plate, (0, depth / 2 - 0.1, 0)))
    return out if draw.chance(0.5) else [p.mirrored(part) for part in out]


def curved(draw: Draw) -> list[Mesh]:
    """A kidney-shaped club sofa: a bowed seat in the arm of a bowed, tub-like back."""
    radius, sweep = draw.between(0.9, 1.5), draw.between(50, 75)
    depth, seat, top = draw.between(0.55, 0.68), draw.between(0.40, 0.46), draw.between(0.68, 0.84)
    foot, thick = draw.between(0.03, 0.14), draw.between(0.16, 0.26)
    angle = np.radians(np.linspace(90 - sweep, 90 + sweep, 25))
    unit = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])

    def bow(wide: float, low: float, high: float, r: float, trim: int) -> Mesh:
        section = p.rounded_rectangle(wide, high - low, min(0.45 * wide, 0.07), 3)
        path = unit[trim : len(unit) - trim] * r + (0, 0, (low + high) / 2)
        ends = np.ones(len(path))
        ends[[0, -1]] = 0.86
        return p.sweep(section, path, scale=ends)

    middle = radius - depth / 2
    out = [
        bow(depth - 0.04, foot, seat - 0.14, middle, 0),
        bow(depth, seat - 0.16, seat, middle, 0),
    ]
    out.append(bow(thick, foot, top, radius + thick / 2 - 0.04, 0))
    for k in (2, 12, 22):
        for r in (radius, radius - depth + 0.1):
            out.append(p.cylinder(0.025, foot + 0.02, unit[k] * r))
    out = [p.move(part, (0, -radius * 0.75, 0)) for part in out]
    return out


def open_frame(draw: Draw) -> list[Mesh]:
    """A Scandinavian sofa: a slender wooden frame with open arms carries loose cushions."""
    size = sofa_size(draw, draw.count(2, 3))
    x, y = size.inside / 2 + 0.03, size.depth / 2 - 0.06
    deck, rake = size.seat - draw.between(0.11, 0.15), draw.between(12, 20)
    section = leg_section(draw.chance(0.5), draw.between(0.04, 0.055))
    lean, drop = draw.between(0.0, 0.07), draw.between(0.0, 0.05)
    out = both_sides(post([(x, -y - lean, 0), (x, -y, size.rest)], section, [0.65, 1]))
    out += both_sides(post([(x, y + 0.06, 0), (x, y, size.rest - drop)], section, [0.65, 1]))
    arm = np.array([(x, -y - 0.06, size.rest), (x, y + 0.1, size.rest - drop)])
    out += both_sides(p.sweep(p.rounded_rectangle(0.07, 0.03, 0.012, 2), arm))
    out.append(p.box((2 * x, 2 * y, 0.05), (0, 0, deck - 0.05)))
    out += seat_cushions(size, size.seat - deck, -y - 0.03, y - 0.08)
    slope = float(np.tan(np.radians(rake)))
    for z in np.linspace(deck + 0.06, size.top - 0.08, 4):
        at = y - 0.04 + slope * (z - deck)
        out.append(p.beam((-x, at, z), (x, at, z), (0.02, 0.05)))
    for s in np.linspace(-1, 1, size.seats + 1):
        low, high = deck - 0.03, size.top - 0.03
        path = [(s * x, y - 0.04 + slope * (z - deck), z) for z in (low, high)]
        out.append(post(path, p.rectangle(0.04, 0.035)))
    rear = y - 0.07 + slope * (size.seat - deck)
    return out + back_cushions(draw, size, 0.12, rear, rake)


def modular(draw: Draw) -> list[Mesh]:
    """Low, plump, bean-like blocks pushed together: a row, or a row with a footstool or corner."""
    block, seat, top = draw.between(0.78, 0.95), draw.between(0.36, 0.42), draw.between(0.60, 0.74)
    count, depth = draw.count(2, 3), draw.between(0.9, 1.02)
    soft, width = draw.between(0.10, 0.16), block * count
    out = []
    for k in range(count):
        x = (k + 0.5) * block - width / 2
        out.append(p.rounded_box((block, depth, seat), (x, 0, 0), soft, 0.05))
        shape = (block * 0.98, 0.26, top - seat + 0.16)
        at = (x, depth / 2, seat - 0.14)
        out.append(back_cushion(shape, at, rake=draw.between(0, 6), crown=0.07, radius=0.12))
    extra = draw.pick("none", "stool", "arms", "corner")
    if extra == "stool":
        at = (width / 2 - block / 2, -depth * 0.92, 0)
        out.append(p.rounded_box((block, 0.85 * depth, seat), at, soft, 0.05))
    elif extra == "arms":
        side = p.rounded_box((0.25, depth, seat + 0.14), (width / 2 + 0.1, 0, 0), 0.1, 0.03)
        out += both_sides(side)
    elif extra == "corner":
        x = width / 2 - block / 2
        out.append(p.rounded_box((block, block, seat), (x, -depth / 2 - block / 2, 0), soft, 0.05))
        wall = back_cushion(
            (block + depth, 0.26, top - seat + 0.16), (0, 0, 0), rake=0, crown=0.07, radius=0.12
        )
        out.append(p.move(p.turn(wall, -90), (x + block / 2, -block / 2, seat - 0.14)))
    return out


FAMILIES: tuple[Family, ...] = (
    train(cushioned),
    train(loveseat),
    train(chaise),
    train(chesterfield),
    train(settee),
    train(sofa_bed),
    train(modular),
    test(day_bed),
    test(curved),
    test(open_frame),
)
