"""Plants: in pots, vases and troughs, from a snake plant to a small tree."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.parts import (
    Vector,
    arc,
    box,
    ellipse,
    ellipsoid,
    lathe,
    leaf,
    rectangle,
    rod,
    shell,
    tube,
)
from qs3.meshes.catalogue.plant_parts import blade, draw_pot, leaves_along, toward
from qs3.meshes.mesh import Mesh


def potted_leaves(draw: Draw) -> list[Mesh]:
    """Broad leaves on arching stems from the middle of a pot."""
    width = draw.between(0.16, 0.34)
    parts, soil, r = draw_pot(draw, width)
    count, reach = draw.count(16, 30), width * draw.between(0.7, 1.2)
    large = reach * draw.between(0.6, 0.95)
    for k in range(count):
        heading, rise = 137.5 * k + draw.between(-20, 20), draw.between(0.3, 1.6)
        out = reach * draw.between(0.2, 0.9)
        base = np.array([0, 0, soil - 0.01]) + 0.4 * r * toward(heading)
        tip = base + out * toward(heading) + np.array([0, 0, reach * rise])
        stem = arc(base, 0.5 * (base + tip) + np.array([0, 0, 0.25 * reach]), tip, 5)
        parts.append(tube(stem, 0.005, sides=6))
        size = large * draw.between(0.75, 1.2)
        drop = draw.between(0.3, 0.9)
        parts.append(blade(tip, heading, 15, size, 0.6 * size, drop, 0.35, 6))
    return parts


def snake(draw: Draw) -> list[Mesh]:
    """Stiff upright blades."""
    width = draw.between(0.15, 0.3)
    parts, soil, r = draw_pot(draw, width)
    length, broad = draw.between(0.35, 0.9), draw.between(0.045, 0.08)
    for k in range(draw.count(8, 18)):
        heading = 137.5 * k + draw.between(-30, 30)
        base = np.array([0, 0, soil - 0.01]) + r * draw.between(0.1, 0.65) * toward(heading)
        size = length * draw.between(0.55, 1.0)
        tip = base + size * toward(heading, draw.between(70, 88))
        middle = 0.5 * (base + tip) + 0.04 * size * toward(draw.between(0, 360))
        across = toward(heading + 90 + draw.between(-50, 50))
        path = arc(base, middle, tip, 6)
        parts.append(leaf(path, broad, across=across, thickness=0.012, belly=0.5))
    return parts


def palm(draw: Draw) -> list[Mesh]:
    """Feathered fronds on a trunk or straight from the soil."""
    width = draw.between(0.24, 0.4)
    parts, soil, _ = draw_pot(draw, width)
    trunk = draw.pick(0.05, draw.between(0.2, 0.7), draw.between(0.3, 0.7))
    rings = [(0.03 + 0.008 * (k % 2), 0.05 * k) for k in range(max(int(trunk / 0.05), 2))]
    parts.append(lathe(rings, (0, 0, soil - 0.02), sides=12))
    top = soil - 0.03 + rings[-1][1]
    length = draw.between(0.55, 0.95)
    for k in range(draw.count(8, 12)):
        heading, pitch = 137.5 * k, draw.between(35, 80)
        size = length * draw.between(0.75, 1.1)
        base = np.array([0, 0, top])
        tip = base + size * toward(heading, pitch) - np.array([0, 0, 0.45 * size])
        path = arc(base, base + 0.6 * size * toward(heading, pitch + 6), tip, 12)
        parts.append(tube(path, 0.006, scale=np.linspace(1.2, 0.4, 13), sides=6))
        for i in range(3, 13):
            for side in (-1, 1):
                leaflet = size * 0.34 * (1.1 - 0.05 * i)
                turned = heading + side * draw.between(45, 60)
                parts.append(blade(path[i], turned, 5, leaflet, 0.035, 0.4, 0.3, 3))
    return parts


def bush(draw: Draw) -> list[Mesh]:
    """A dense ball of small leaves on short branches."""
    width = draw.between(0.18, 0.4)
    parts, soil, _ = draw_pot(draw, width)
    radius = width * draw.between(0.7, 1.2)
    flat = draw.between(0.75, 1.2)
    size = radius * draw.between(0.3, 0.5)
    root = np.array([0, 0, soil - 0.01])
    centre = np.array([0, 0, soil + 0.75 * radius * flat])
    for k in range(draw.count(20, 28)):
        way = toward(137.5 * k, draw.between(-35, 80)) * (1, 1, flat)
        tip = centre + 0.85 * radius * draw.between(0.8, 1.1) * way
        path = arc(root, 0.5 * (root + tip) + np.array([0, 0, 0.1 * radius]), tip, 5)
        parts.append(tube(path, 0.004, sides=5))
        parts += leaves_along(draw, path, 8, size, 0.65 * size, 0.4)
    return parts


def cactus(draw: Draw) -> list[Mesh]:
    """Ribbed columns, some with raised arms, or a ribbed ball."""
    width = draw.between(0.12, 0.3)
    parts, soil, r = draw_pot(draw, width)
    ribs = draw.count(7, 12)
    thick = r * draw.between(0.4, 0.65)
    height = draw.pick(1.6 * thick, draw.between(0.25, 0.8), draw.between(0.25, 0.8))
    parts.append(_column(ribs, thick, height, (0, 0, soil - 0.02)))
    if height > 2 * thick:
        for k in range(draw.count(0, 3)):
            level = soil + height * draw.between(0.3, 0.55)
            heading, arm = 140 * k + draw.between(-30, 30), 0.6 * thick
            up = np.array([0, 0, arm])
            out = np.array([0, 0, level]) + 2.3 * thick * toward(heading)
            bend = arc((0, 0, level - 0.2 * thick), out - up, out + up, 6)
            parts.append(tube(bend, 0.9 * arm, sides=12))
            rise = height * draw.between(0.2, 0.4)
            parts.append(_column(ribs, arm, rise, (out[0], out[1], level + 0.2 * arm)))
    for k in range(draw.count(0, 3)):
        at = 0.75 * r * toward(120 * k + 40)
        ball = thick * draw.between(0.35, 0.6)
        parts.append(_column(ribs, ball, 1.7 * ball, (at[0], at[1], soil - 0.01)))
    return parts


def _column(ribs: int, radius: float, height: float, at: Vector) -> Mesh:
    """A ribbed column with a round top."""
    angle = np.linspace(0, 2 * np.pi, 4 * ribs, endpoint=False)
    wave = radius * (0.9 + 0.13 * np.cos(ribs * angle))
    curve = np.column_stack([wave * np.cos(angle), wave * np.sin(angle)])
    cap = min(radius, 0.6 * height)
    profile = [(0.85, 0.0), (1.0, min(0.5 * radius, 0.3 * height))]
    for a in np.linspace(0, 0.47 * np.pi, 6):
        profile.append((float(np.cos(a)), height - cap + cap * float(np.sin(a))))
    return shell(curve, profile, at)


def small_tree(draw: Draw) -> list[Mesh]:
    """A thin trunk, or two, with a leafy crown, as tall as a person."""
    width = draw.between(0.28, 0.42)
    parts, soil, _ = draw_pot(draw, width)
    height, crown = draw.between(0.9, 1.6), draw.between(0.28, 0.45)
    trunks, long = draw.count(1, 2), draw.between(0.12, 0.2)
    for k in range(trunks):
        base = np.array([0.04 * k * trunks, 0.02 * k, soil - 0.02])
        lean = 0.08 * toward(draw.between(0, 360))
        top = base + np.array([0, 0, height * (1 - 0.25 * k) - crown]) + lean
        path = arc(base, 0.5 * (base + top) + lean, top, 8)
        parts.append(tube(path, 0.018, scale=np.linspace(1.1, 0.7, 9)))
        for i in range(draw.count(11, 16)):
            start = path[draw.count(5, 8)]
            end = top + crown * draw.between(0.5, 1.0) * toward(137.5 * i, draw.between(-25, 85))
            branch = arc(start, 0.5 * (start + end) + np.array([0, 0, 0.08]), end, 5)
            parts.append(tube(branch, 0.006, sides=5))
            parts += leaves_along(draw, branch, 12, long, 0.5 * long, 0.3)
    return parts


def grass(draw: Draw) -> list[Mesh]:
    """Many narrow blades that arch over the rim, as of a spider plant."""
    width = draw.between(0.12, 0.28)
    parts, soil, r = draw_pot(draw, width)
    length, broad = width * draw.between(1.4, 2.8), draw.between(0.014, 0.03)
    droop = draw.between(0.3, 1.0)
    for k in range(draw.count(50, 90)):
        heading = 137.5 * k
        base = np.array([0, 0, soil - 0.01]) + 0.3 * r * draw.between(0, 1) * toward(heading)
        size, pitch = length * draw.between(0.55, 1.05), draw.between(40, 88)
        sink = droop * draw.between(0.6, 1.3) * np.cos(np.radians(0.8 * pitch)) * 1.4
        parts.append(blade(base, heading, pitch, size, broad, float(sink), 0.3, 6))
    return parts


def vase_flowers(draw: Draw) -> list[Mesh]:
    """Flowers in a vase: stems, heads with petals, a few leaves."""
    height, r = draw.between(0.18, 0.34), draw.between(0.045, 0.08)
    neck = draw.between(0.5, 1.0)
    outline = [(0.7, 0), (1.0, 0.2), (1.05, 0.45), (neck, 0.8), (1.1 * neck, 1.0)]
    outer = [(r * s, height * z) for s, z in outline]
    inner = [(0.9 * outer[-1][0], height), (0.85 * r * neck, 0.75 * height)]
    parts = [lathe([*outer, *inner, (0, 0.7 * height)], sides=24)]
    spread, tall = draw.between(15, 35), height * draw.between(1.0, 1.7)
    petal, count = draw.between(0.025, 0.05), draw.count(5, 9)
    for k in range(draw.count(7, 14)):
        heading, pitch = 137.5 * k, 90 - spread * draw.between(0.1, 1.1)
        base = np.array([0, 0, 0.65 * height])
        tip = base + tall * draw.between(0.85, 1.15) * toward(heading, pitch)
        path = arc(base, base + 0.5 * tall * np.array([0, 0, 1]), tip, 6)
        parts.append(tube(path, 0.003, sides=5))
        parts.append(ellipsoid((0.6 * petal, 0.6 * petal, 0.5 * petal), tip, sides=8, rings=5))
        for i in range(count):
            around = 360 * i / count
            parts.append(blade(tip, around, draw.between(10, 40), petal, 0.6 * petal, 0.1, 0.6, 3))
        if draw.chance(0.7):
            parts += leaves_along(draw, path[2:], 3, 0.09, 0.035, 0.1)
    return parts


def dracaena(draw: Draw) -> list[Mesh]:
    """Bare canes of different heights, each with a rosette of sword-like leaves."""
    width = draw.between(0.24, 0.36)
    parts, soil, r = draw_pot(draw, width)
    tallest, sword = draw.between(0.5, 1.2), draw.between(0.3, 0.5)
    for k in range(draw.count(1, 4)):
        base = np.array([0, 0, soil - 0.02]) + 0.4 * r * toward(120 * k + 30)
        top = base + np.array([0, 0, tallest * (1 - 0.27 * k)]) + 0.08 * toward(120 * k)
        parts.append(tube(arc(base, 0.5 * (base + top), top, 5), draw.between(0.014, 0.024)))
        for i in range(draw.count(18, 30)):
            start = top - np.array([0, 0, draw.between(0, 0.1)])
            size, pitch = sword * draw.between(0.7, 1.1), draw.between(0, 85)
            sink = draw.between(0.2, 0.6) * np.cos(np.radians(pitch))
            parts.append(blade(start, 137.5 * i, pitch, size, 0.045, float(sink), 0.3))
    return parts


def trailing(draw: Draw) -> list[Mesh]:
    """Vines that hang over the rim of a tall planter or of a bowl on legs."""
    height, r = draw.between(0.45, 0.85), draw.between(0.1, 0.17)
    bowl = min(height, draw.pick(height, 0.2))
    profile = [(0.75, height - bowl), (1, height - 0.1), (1, height), (0.92, height)]
    parts = [shell(ellipse(2 * r, 2 * r), [*profile, (0.92, height - 0.03)])]
    if bowl < height:
        for k in range(3):
            way = toward(120 * k + 90)
            top = 0.85 * r * way + np.array([0, 0, height - 0.12])
            parts.append(rod(top, 1.35 * r * way, 0.011))
    for k in range(draw.count(10, 16)):
        heading = 137.5 * k
        out, fall = r * draw.between(1.1, 1.5), draw.between(0.1, 0.85) * (height - 0.05)
        start = np.array([0, 0, height - 0.04]) + 0.4 * r * toward(heading)
        over = out * toward(heading) + np.array([0, 0, height + 0.02])
        end = 1.05 * out * toward(heading + 10) + np.array([0, 0, height - fall])
        rise = arc(start, 0.5 * (start + over) + np.array([0, 0, 0.1]), over, 4)
        path = np.concatenate([rise, arc(over, over - np.array([0, 0, 0.02]), end, 5)[1:]])
        parts.append(tube(path, 0.003, sides=5))
        parts += leaves_along(draw, path, 6 + int(14 * fall), 0.07, 0.05, 0.1)
    return parts


def conifer(draw: Draw) -> list[Mesh]:
    """A little fir or a clipped cone: whorls of branches that shorten upwards."""
    width = draw.between(0.18, 0.34)
    parts, soil, _ = draw_pot(draw, width)
    height, spread = draw.between(0.5, 1.3), draw.between(0.2, 0.34)
    parts.append(rod((0, 0, soil - 0.02), (0, 0, soil + height), 0.018, 0.005))
    whorls = draw.count(8, 13)
    for k in range(whorls):
        t = k / whorls
        level, reach = soil + height * (0.1 + 0.9 * t), height * spread * (1.08 - t)
        for i in range(10):
            heading = 36 * i + 17 * k + draw.between(-8, 8)
            size = reach * draw.between(0.85, 1.1)
            pitch = draw.between(-5, 20)
            needle = blade((0, 0, level), heading, pitch, size, 0.3 * size + 0.02, 0.25, 0.55)
            parts.append(needle)
    return [*parts, blade((0, 0, soil + 0.95 * height), 0, 89, 0.12 * height, 0.03, 0.0)]


def trough(draw: Draw) -> list[Mesh]:
    """A long box with a row of upright plants."""
    length, depth, height = (
        draw.between(0.5, 1.0),
        draw.between(0.16, 0.26),
        draw.between(0.18, 0.4),
    )
    curve = rectangle(length, depth)
    profile = [(0.96, 0.0), (1.0, height), (0.95, height), (0.95, 0.88 * height)]
    parts = [shell(curve, profile)]
    count = int(length / draw.between(0.12, 0.2))
    tall, slender = draw.between(0.25, 0.6), draw.chance(0.4)
    for k in range(count):
        x = length * ((k + 0.5) / count - 0.5) * 0.9
        root = np.array([x, draw.between(-0.1, 0.1) * depth, 0.86 * height])
        if slender:
            for i in range(14):
                size, pitch = tall * draw.between(0.6, 1.1), draw.between(55, 88)
                parts.append(blade(root, 137.5 * i, pitch, size, 0.02, 0.25, 0.3, 5))
            continue
        for i in range(6):
            way = toward(137.5 * i + 30 * k, draw.between(60, 85))
            tip = root + tall * draw.between(0.7, 1.1) * way
            path = arc(root, 0.5 * (root + tip), tip, 5)
            parts.append(tube(path, 0.004, sides=5))
            parts += leaves_along(draw, path, 9, 0.15, 0.09, 0.1)
    if draw.chance(0.4):
        for x in (-0.42 * length, 0.42 * length):
            parts.append(box((0.04, depth, 0.05), (x, 0, -0.045)))
    return parts


FAMILIES: tuple[Family, ...] = (
    train(potted_leaves),
    train(snake),
    train(palm),
    train(bush),
    train(cactus),
    train(small_tree),
    train(grass),
    test(vase_flowers),
    test(dracaena),
    test(trailing),
    test(conifer),
    train(trough),
)
