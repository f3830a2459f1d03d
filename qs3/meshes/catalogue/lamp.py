"""Lamps: floor and table lamps with shades, jointed and arched ones, lanterns, spots."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.lamp_parts import aim, bulb, draw_foot, draw_shade, hood, shade
from qs3.meshes.catalogue.parts import (
    arc,
    box,
    cylinder,
    ellipse,
    ellipsoid,
    frustum,
    lathe,
    move,
    rectangle,
    ring_at,
    rod,
    rounded_rectangle,
    shell,
    slab,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh


def floor_shade(draw: Draw) -> list[Mesh]:
    """A pole with a large shade."""
    height, width = draw.between(1.25, 1.6), draw.between(0.3, 0.52)
    parts, z = draw_foot(draw, draw.between(0.24, 0.34))
    cover = draw_shade(draw, width, (0, 0, 0))
    rise = height - 0.4 * width
    top = rise + 0.8 * float(cover[0].bounds[1, 2])
    pole = draw.between(0.008, 0.018)
    parts.append(cylinder(pole, top - z + 0.01, (0, 0, z - 0.005)))
    if draw.chance(0.4):
        for level in np.linspace(0.25, 0.9, draw.count(1, 3)):
            centre = (0, 0, z + level * (rise - z))
            parts.append(ellipsoid((0.07, 0.07, draw.between(0.05, 0.12)), centre))
    if draw.chance(0.35):
        parts.append(cylinder(draw.between(0.15, 0.24), 0.02, (0, 0, draw.between(0.45, 0.65))))
    return parts + [move(part, (0, 0, rise)) for part in cover]


def table_shade(draw: Draw) -> list[Mesh]:
    """A turned or glazed body with a shade."""
    body, width = draw.between(0.18, 0.38), draw.between(0.22, 0.45)
    belly = draw.between(0.22, 0.42) * width
    shape = draw.pick(
        [(0.7, 0), (0.75, 0.06), (0.5, 0.1), (0.9, 0.3), (1, 0.5), (0.75, 0.8), (0.3, 0.97)],
        [(0.55, 0), (0.8, 0.15), (1, 0.4), (0.95, 0.65), (0.6, 0.88), (0.25, 1)],
        [(1, 0), (1, 0.08), (0.35, 0.16), (0.3, 0.5), (0.5, 0.6), (0.3, 0.7), (0.25, 1)],
        [(0.65, 0), (0.7, 0.02), (0.7, 0.95), (0.55, 1)],
        [(1, 0), (1, 0.1), (0.25, 0.16), (0.2, 1)],
    )
    profile = [(belly * r, body * z) for r, z in shape]
    if draw.chance(0.25):  # square
        square = rounded_rectangle(2, 2, 0.3)
        main = shell(square, profile)
    else:
        main = lathe(profile, sides=24)
    cover = draw_shade(draw, width, (0, 0, body + draw.between(0.0, 0.04)))
    neck = rod((0, 0, body - 0.02), (0, 0, cover[1].bounds[1, 2] + 0.002), 0.008)
    parts = [main, neck, *cover]
    if draw.chance(0.5):
        parts.append(cylinder(1.05 * profile[0][0] + 0.01, 0.016, (0, 0, -0.014), sides=24))
    return parts


def desk_arm(draw: Draw) -> list[Mesh]:
    """Two arms with joints, a reflector at their end."""
    r = draw.between(0.07, 0.11)
    foot = draw.pick(cylinder(r, 0.025, sides=24), box((2 * r, 1.7 * r, 0.03)))
    first, second = draw.between(0.25, 0.42), draw.between(0.25, 0.42)
    lean, dip = np.radians(draw.between(5, 35)), np.radians(draw.between(5, 60))
    hinge = np.array([0, 0, 0.06])
    elbow = hinge + first * np.array([0, np.sin(lean), np.cos(lean)])
    wrist = elbow + second * np.array([0, -np.cos(dip), np.sin(dip)])
    parts = [foot, cylinder(0.014, 0.05, (0, 0, 0.015))]
    twin = draw.chance(0.6)
    for x in (-0.012, 0.012) if twin else (0.0,):
        bar = 0.004 if twin else 0.008
        side = np.array([x, 0, 0])
        parts.append(rod(hinge + side, elbow + side, bar, sides=6))
        parts.append(rod(elbow + side, wrist + side, bar, sides=6))
    for joint in (hinge, elbow, wrist):
        knob = turn(cylinder(0.016, 0.044, (0, 0, -0.022), sides=12), 90, "y")
        parts.append(move(knob, joint))
    radius, depth = draw.between(0.06, 0.1), draw.between(0.1, 0.16)
    bell = hood(radius, depth, 0.025, draw.chance(0.3))
    tilt = draw.between(-10, 45)
    head = [move(bell, (0, 0, -depth)), cylinder(0.02, 0.04, (0, 0, -0.02))]
    head.append(bulb((0, 0, 0.02 - depth * 0.75)))
    return parts + [aim(part, tilt, 0, tuple(wrist)) for part in head]


def arc_floor(draw: Draw) -> list[Mesh]:
    """A long bow from a heavy foot, the shade hanging at its end."""
    reach, height = draw.between(0.8, 1.3), draw.between(1.4, 1.75)
    start, drop = draw.between(0.2, 0.9), draw.between(0.15, 0.5)
    z = draw.between(0.04, 0.09)
    r = draw.between(0.13, 0.19)
    foot = draw.pick(cylinder(r, z, sides=28), box((2 * r, 1.4 * r, z)))
    bow = arc((0, 0, start), (0.05 * reach, 0, 2 * height - start), (0.9 * reach, 0, height), 14)
    tip = arc(bow[-1], bow[-1] + (0.1 * reach, 0, -0.1), (reach, 0, height - drop), 4)
    path = np.concatenate([[(0, 0, 0.5 * z)], bow, tip[1:]])
    parts = [foot, tube(path, draw.between(0.009, 0.016))]
    radius = draw.between(0.14, 0.24)
    depth = radius * draw.between(0.75, 1.1)
    if draw.chance(0.65):
        parts.append(move(hood(radius, depth, 0.05, True), (reach, 0, height - drop - depth)))
        parts.append(bulb((reach, 0, height - drop - 0.12)))
    else:
        parts += shade(radius, radius, depth, (reach, 0, height - drop - 0.8 * depth))
    return parts


def tripod(draw: Draw) -> list[Mesh]:
    """Three slanting legs under a drum or empire shade."""
    big = draw.chance(0.65)
    height = draw.between(0.95, 1.25) if big else draw.between(0.28, 0.4)
    spread = height * draw.between(0.22, 0.32)
    width = height * draw.between(0.32, 0.42) if big else height * draw.between(0.7, 1.0)
    thick = draw.between(0.012, 0.02) if big else 0.009
    parts = [cylinder(2.2 * thick, 0.05, (0, 0, height - 0.03))]
    for k in range(3):
        a = np.radians(90 + 120 * k)
        end = np.array([np.cos(a), np.sin(a), 0])
        over = draw.between(0.0, 0.02)
        top = np.array([0, 0, height + over]) + 1.3 * thick * end
        parts.append(rod(top, spread * end, thick, 0.7 * thick))
    if draw.chance(0.4):
        z = draw.between(0.35, 0.55) * height
        parts.append(cylinder(spread * (1 - z / height) + 0.01, 0.012, (0, 0, z), sides=20))
    cover = draw_shade(draw, width, (0, 0, height + 0.01))
    parts.append(rod((0, 0, height - 0.02), (0, 0, cover[1].bounds[1, 2]), 0.008))
    return parts + cover


def paper_tall(draw: Draw) -> list[Mesh]:
    """A tall paper body with ribs on a small stand."""
    height, width = draw.between(0.6, 1.5), draw.between(0.22, 0.36)
    curve = draw.pick(
        rectangle(width, width), ellipse(width, width, 24), rounded_rectangle(width, width, 0.06)
    )
    taper, bulge = draw.between(0.75, 1.1), draw.pick(0.0, 0.0, draw.between(0.1, 0.35))
    legs = draw.between(0.03, 0.12)
    ribs = draw.count(6, 18)
    profile: list[tuple[float, float]] = []
    for t in np.linspace(0, 1, 2 * ribs + 1):
        scale = 1 + t * (taper - 1) + bulge * np.sin(np.pi * t)
        pleat = 0.96 if len(profile) % 2 else 1.0
        profile.append((float(scale) * pleat, legs + t * height))
    parts = [shell(curve, profile)]
    reach = 0.4 * width
    for k in range(4):
        a = np.radians(45 + 90 * k)
        x, y = reach * np.cos(a), reach * np.sin(a)
        parts.append(box((0.018, 0.018, legs + 0.02), (x, y, 0)))
    parts.append(slab(0.92 * curve, 0.012, (0, 0, legs - 0.008)))
    return parts


def uplighter(draw: Draw) -> list[Mesh]:
    """A torchiere: a pole with a bowl open to the ceiling, perhaps with a reading arm."""
    height = draw.between(1.55, 1.9)
    parts, z = draw_foot(draw, draw.between(0.24, 0.32))
    parts.append(cylinder(draw.between(0.01, 0.016), height - z, (0, 0, z - 0.005)))
    radius = draw.between(0.13, 0.21)
    depth = radius * draw.between(0.4, 0.8)
    bowl = turn(hood(radius, depth, 0.04, draw.chance(0.7)), 180, "x")
    parts.append(move(bowl, (0, 0, height + depth - 0.02)))
    if draw.chance(0.45):
        level, reach = height * draw.between(0.6, 0.72), draw.between(0.25, 0.4)
        heading = draw.between(-60, 60)
        arm = tube(arc((0, 0, level), (0, -0.6 * reach, level), (0, -reach, level + 0.12)), 0.007)
        head = hood(0.06, 0.12, 0.025, False)
        parts += [
            turn(arm, heading),
            turn(aim(head, 20, 0, (0, -reach, level)), heading),
        ]
    return parts


def globe(draw: Draw) -> list[Mesh]:
    """One glass ball, or a few on a stem."""
    size = draw.between(0.16, 0.3)
    if draw.chance(0.5):
        foot = draw.between(0.3, 0.6) * size
        high = draw.between(0.02, 0.12)
        parts = [
            lathe([(foot, 0), (foot, 0.015), (0.2 * size, 0.02), (0.2 * size, high)], sides=24)
        ]
        tall = size * draw.between(0.85, 1.25)
        ball = ellipsoid((size, size, tall), (0, 0, high + 0.45 * tall), sides=24, rings=14)
        return [*parts, ball]
    height, count = draw.between(1.2, 1.6), draw.count(2, 4)
    parts, z = draw_foot(draw, 0.28)
    parts.append(cylinder(0.01, height - z, (0, 0, z - 0.005)))
    size *= 0.75
    for k in range(count):
        a, level = 2 * np.pi * k / count, height - 0.16 * k
        end = np.array([0.17 * np.cos(a), 0.17 * np.sin(a), level])
        parts.append(rod((0, 0, level - 0.03), end, 0.007))
        centre = (end[0], end[1], level + 0.4 * size)
        parts.append(ellipsoid((size, size, size), centre, sides=20, rings=11))
    return parts


def spot_pole(draw: Draw) -> list[Mesh]:
    """A pole with two to four small spots on short arms."""
    height = draw.between(1.3, 1.75)
    parts, z = draw_foot(draw, draw.between(0.22, 0.3))
    parts.append(cylinder(draw.between(0.009, 0.015), height - z, (0, 0, z - 0.005)))
    radius, depth = draw.between(0.04, 0.065), draw.between(0.11, 0.18)
    for k in range(draw.count(2, 4)):
        level, heading = height - 0.05 - 0.21 * k, 140 * k + draw.between(-40, 40)
        reach = draw.between(0.07, 0.13)
        end = (0, -reach, level)
        arm = rod((0, 0, level), end, 0.007)
        head = move(hood(radius, depth, 0.55 * radius, False), (0, 0, -0.6 * depth))
        tilt = draw.between(25, 115)
        parts += [turn(arm, heading), turn(aim(head, tilt, 0, end), heading)]
    return parts


def gooseneck(draw: Draw) -> list[Mesh]:
    """A bent tube over a foot, a bell at its end; for the desk or, large, beside a chair."""
    large = draw.chance(0.4)
    height = draw.between(1.15, 1.4) if large else draw.between(0.32, 0.5)
    reach = draw.between(0.25, 0.4) if large else draw.between(0.16, 0.28)
    r = 0.13 if large else draw.between(0.07, 0.1)
    bend = min(0.55 * height, 0.4)
    stem = arc((0, 0, height - bend), (0, 0, height + 0.45 * bend), (0, -0.7 * reach, height), 10)
    droop = arc(stem[-1], stem[-1] + (0, -0.3 * reach, -0.1 * bend), (0, -reach, height - 0.06), 3)
    path = np.concatenate([[(0, 0, 0.015)], stem, droop[1:]])
    parts = [lathe([(r, 0), (r, 0.012), (0.6 * r, 0.03), (0.2 * r, 0.045)], sides=24)]
    parts.append(tube(path, 0.01 if large else 0.007))
    radius = draw.between(0.07, 0.1)
    depth = draw.between(0.1, 0.15)
    bell = move(hood(radius, depth, 0.03, draw.chance(0.5)), (0, 0, 0.01 - depth))
    return [*parts, aim(bell, draw.between(5, 40), 0, (0, -reach, height - 0.06))]


def lantern(draw: Draw) -> list[Mesh]:
    """A glass housing between corner posts, with a roof and a ring."""
    width, height = draw.between(0.16, 0.3), draw.between(0.25, 0.5)
    post = draw.between(0.014, 0.026)
    z = draw.between(0.025, 0.05)
    parts = [box((1.12 * width, 1.12 * width, z))]
    inner = 0.5 * (width - post)
    for x in (-inner, inner):
        for y in (-inner, inner):
            parts.append(box((post, post, height + 0.01), (x, y, z - 0.005)))
    for x, y, w, d in [(0, -1, 1, 0), (0, 1, 1, 0), (-1, 0, 0, 1), (1, 0, 0, 1)]:
        pane = (w * width or 0.004, d * width or 0.004, height)
        if draw.chance(0.8):
            parts.append(box(pane, (x * inner, y * inner, z)))
        bar = (w * width or 0.6 * post, d * width or 0.6 * post, 0.6 * post)
        parts.append(box(bar, (x * inner, y * inner, z + height * draw.between(0.45, 0.55))))
    parts.append(cylinder(0.22 * width, height * draw.between(0.3, 0.6), (0, 0, z - 0.004)))
    roof, top = draw.between(0.08, 0.2), z + height
    eaves = 1.25 * width
    parts.append(box((eaves, eaves, 0.015), (0, 0, top)))
    parts.append(frustum((eaves, eaves), (0.3 * width, 0.3 * width), roof, (0, 0, top + 0.014)))
    parts.append(cylinder(0.12 * width, 0.03, (0, 0, top + roof + 0.01)))
    ring = ring_at(ellipse(0.5 * width, 0.5 * width, 16), 0.0)[:, [0, 2, 1]]
    centre = (0, 0, top + roof + 0.03 + 0.25 * width)
    return [*parts, tube(ring + centre, 0.006, sides=6, loop=True)]


def pendant_stand(draw: Draw) -> list[Mesh]:
    """A bracket like a gallows from which a shade hangs on its cord."""
    height, reach = draw.between(1.35, 1.75), draw.between(0.3, 0.5)
    thick = draw.between(0.02, 0.035)
    parts = [
        slab(rounded_rectangle(0.3, draw.between(0.24, 0.34), 0.03), 0.025, (0.0, 0, 0)),
        box((thick, thick, height), (0, 0, 0.01)),
        box((reach + 0.5 * thick, thick, thick), (0.5 * reach, 0, height - 0.3 * thick)),
    ]
    if draw.chance(0.6):
        brace = 0.55 * reach
        parts.append(rod((0, 0, height - brace), (brace, 0, height), 0.35 * thick))
    cord, radius = draw.between(0.1, 0.35), draw.between(0.13, 0.22)
    depth = radius * draw.between(0.8, 1.5)
    low = height - cord - depth
    parts.append(rod((reach, 0, height), (reach, 0, low + 0.6 * depth), 0.004, sides=6))
    kind = draw.count(0, 2)
    if kind == 0:
        parts += shade(radius, 0.9 * radius, depth, (reach, 0, low))
    elif kind == 1:
        bell = hood(radius, depth, 0.04, draw.chance(0.5))
        parts += [move(bell, (reach, 0, low)), bulb((reach, 0, low + 0.45 * depth))]
    else:
        size = (2 * radius, 2 * radius, 1.7 * radius)
        parts.append(ellipsoid(size, (reach, 0, low + 0.5 * depth), sides=22, rings=12))
    return parts


def mushroom(draw: Draw) -> list[Mesh]:
    """A dome on a trumpet-shaped or bulbous stem."""
    height, radius = draw.between(0.25, 0.5), draw.between(0.13, 0.24)
    waist, foot = draw.between(0.12, 0.3), draw.between(0.5, 0.75)
    stem = [(foot, 0), (0.9 * foot, 0.06), (waist, 0.5), (waist, 0.8), (1.5 * waist, 1.02)]
    body = lathe([(radius * r, height * z) for r, z in stem], sides=24)
    depth = radius * draw.between(0.55, 0.95)
    cap = move(hood(radius, depth, 0.03, True), (0, 0, 1.02 * height - 0.6 * depth))
    inside = 0.02 * height + 0.37 * depth + 0.01  # the stem reaches into the dome
    support = cylinder(1.4 * waist * radius, inside, (0, 0, height - 0.01), top=0.02)
    knob = ellipsoid((0.03, 0.03, 0.03), (0, 0, 1.02 * height + 0.41 * depth))
    return [body, cap, support, knob]


FAMILIES: tuple[Family, ...] = (
    train(floor_shade),
    train(table_shade),
    train(desk_arm),
    train(arc_floor),
    train(tripod),
    train(paper_tall),
    train(uplighter),
    train(globe),
    test(spot_pole),
    test(gooseneck),
    test(lantern),
    test(pendant_stand),
    test(mushroom),
)
