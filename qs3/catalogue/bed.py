"""Beds: platforms and box springs, iron beds, cots, bunks and futons; the head is at +y."""

import numpy as np

from qs3.catalogue import furniture as f
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


def mattress(draw: Draw) -> tuple[float, float]:
    """Its width and length."""
    width = draw.pick(0.9, 1.0, 1.2, 1.4, 1.6, 1.8)
    return width + draw.between(-0.03, 0.03), draw.between(1.9, 2.1)


def cover(draw: Draw, width: float, low: float, high: float, start: float, end: float) -> Mesh:
    """A duvet or blanket over a mattress from y = start to end, rumpled on top.

    Its sides hang from the height `high` down to `low`; the mattress is inside it.
    """
    x, rumple = np.linspace(-1, 1, 19), draw.between(0.004, 0.025)
    a, b, c, d = draw.between(3, 9), draw.between(4, 12), draw.between(0, 6), draw.between(0, 6)
    rings = []
    for y in np.linspace(start, end, 16):
        fold = rumple * (1 + np.sin(a * x + c + 2 * np.sin(b * y)) * np.cos(b * y + d))
        edge = 1 - 0.7 * np.abs(x) ** 12 - (0.35 if y in (start, end) else 0.0)
        top = np.stack([x * width / 2, 0 * x + y, high - 0.02 + 0.045 * edge + fold], axis=1)
        flare = width / 2 + 0.012 * np.sin(7 * y + c)
        rings.append(np.concatenate([top, [(flare, y, low), (-flare, y, low)]]))
    return p.loft(np.stack(rings))


def bedding(
    draw: Draw, width: float, length: float, z: float, thick: float, *, upright: bool = True
) -> list[Mesh]:
    """A mattress at height z with its pillows and mostly a cover.

    Pillows may stand `upright` against a headboard.
    """
    parts = [p.rounded_box((width, length, thick), (0, 0, z), radius=0.05, crown=0.012)]
    top, count = z + thick, 1 if width < 1.25 else 2
    if draw.chance(0.85):
        wide, high = min(0.85 * width / count, 0.7), draw.between(0.11, 0.18)
        lean = draw.pick(0.0, 8.0, 15.0, 55.0 if upright else 4.0)
        rise = 0.5 * high + 0.5 * (0.42 - high) * float(np.sin(np.radians(lean)))
        y = length / 2 - 0.21 * float(np.cos(np.radians(lean))) - 0.07
        for k in range(count):
            x = width * ((k + 0.5) / count - 0.5) + draw.between(-0.03, 0.03)
            body = p.turn(p.pillow((wide, 0.42, high), (0, 0, -high / 2)), lean, "x")
            parts.append(p.move(p.turn(body, draw.between(-7, 7)), (x, y, top + rise)))
    kind = draw.pick("duvet", "duvet", "duvet", "throw", "bare")
    if kind != "bare":
        drop = min(top - 0.01, draw.between(0.4, 1.3) * thick)  # not through the floor
        start, end = -0.025, draw.between(0.62, 0.8) * length
        if kind == "throw":
            start, end = draw.between(0.05, 0.2), draw.between(0.45, 0.7)
        foot = -length / 2
        parts.append(cover(draw, width + 0.05, top - drop, top, foot + start, foot + end))
    return parts


def board(draw: Draw, width: float, y: float, top: float) -> list[Mesh]:
    """A head- or footboard standing on the floor, its inner face at y, outwards along +y."""
    kind, t = draw.pick("panel", "padded", "slats", "arch"), draw.between(0.03, 0.06)
    if kind == "panel":
        return [p.rounded_box((width, t, top), (0, y + t / 2, 0), radius=0.01, steps=2)]
    if kind == "padded":
        channels = draw.count(1, 7)
        each = width / channels
        parts = [p.box((width - 0.02, 0.04, top - 0.03), (0, y + 0.07, 0))]
        for k in range(channels):
            at = (each * (k + 0.5) - width / 2, y + 0.045, 0.2)
            parts.append(p.rounded_box((each, 0.09, top - 0.2), at, radius=0.035))
        return parts
    if kind == "arch":
        angle, rise = np.linspace(0, np.pi, 17), draw.between(0.1, 0.25)
        curve = [(width / 2 * np.cos(a), top - rise + rise * np.sin(a)) for a in angle]
        outline = np.array([(-width / 2, 0), (width / 2, 0), *curve])
        return [p.move(p.extrude(outline, t, "y"), (0, y, 0))]
    post, count = draw.between(0.05, 0.08), int(width / draw.between(0.09, 0.2))
    parts = f.both_sides(p.box((post, post, top + 0.04), ((width - post) / 2, y + post / 2, 0)))
    parts += [p.box((width - post, t, 0.08), (0, y + t / 2, z)) for z in (0.3 * top, top - 0.08)]
    for k in range(1, count):
        at = (width * (k / count - 0.5), y + t / 2, 0.31 * top)
        parts.append(p.box((0.035, 0.02, 0.68 * top), at))
    return parts


def platform(draw: Draw) -> list[Mesh]:
    """A frame or an upholstered box with a headboard, on legs or on a plinth; some footboards."""
    (width, length), thick = mattress(draw), draw.between(0.16, 0.28)
    deck, rim, rail = draw.between(0.2, 0.4), draw.between(0.02, 0.1), draw.between(0.1, 0.18)
    w, long, lift = width + 2 * rim, length + rim, deck - rail
    parts = [p.rounded_box((w, long, rail), (0, 0, lift), draw.pick(0.005, 0.03))]
    if draw.chance(0.65):
        parts += f.four_legs(w - 0.14, long - 0.14, lift, p.rectangle(0.07, 0.07), foot=0.6)
    else:
        parts.append(p.box((0.75 * w, 0.85 * long, lift), (0, 0, 0)))
    tall = draw.between(0.75, 1.3)
    parts += board(draw, w + draw.pick(0.0, 0.0, 0.5), long / 2, tall)
    if draw.chance(0.3):
        lower = board(draw, w, long / 2, draw.between(0.5, 0.8) * tall)
        parts += [p.mirrored(part, "y") for part in lower]
    return parts + bedding(draw, width, length, deck - 0.03, thick)


def iron(draw: Draw) -> list[Mesh]:
    """A bed of metal tubes: hooped or straight head and foot with upright bars."""
    (width, length), deck = mattress(draw), draw.between(0.32, 0.45)
    tall, r, hooped = draw.between(0.9, 1.25), draw.between(0.014, 0.024), draw.chance(0.6)
    x, parts, count = width / 2 + 0.03, [], int((width + 0.06) / draw.between(0.1, 0.2))
    for side, top in ((1, tall), (-1, tall * draw.between(0.5, 0.85))):
        y, rise = side * (length / 2 + 0.03), (draw.between(0.1, 0.3) if hooped else 0.0)
        shoulder = top - rise
        parts += f.both_sides(p.rod((x, y, 0), (x, y, shoulder), r))
        knob = p.ellipsoid((4 * r, 4 * r, 4 * r), (x, y, shoulder), sides=10, rings=5)
        parts += f.both_sides(knob)
        hoop = p.arc((-x, y, shoulder), (0, y, top + rise), (x, y, shoulder), 14)
        parts += [p.tube(hoop, r), p.rod((-x, y, deck), (x, y, deck), r)]
        for k in range(1, count):
            u = 2 * k / count - 1
            end = (u * x, y, top - rise * u * u)
            parts.append(p.rod((u * x, y, deck), end, 0.5 * r, sides=6))
    parts += f.both_sides(p.box((0.03, length + 0.06, 0.04), (x, 0, deck - 0.03)))
    parts.append(p.box((2 * x, length, 0.015), (0, 0, deck - 0.02)))
    return parts + bedding(draw, width, length, deck - 0.005, draw.between(0.16, 0.25))


def crib(draw: Draw) -> list[Mesh]:
    """A baby's cot: bars all round or panels at the ends, a small mattress."""
    width, length, tall = draw.between(0.62, 0.78), draw.between(1.2, 1.45), draw.between(0.8, 1.05)
    low, deck, post = draw.between(0.12, 0.25), draw.between(0.28, 0.5), draw.between(0.035, 0.055)
    pitch, solid, x, y = draw.between(0.07, 0.095), draw.chance(0.35), width / 2, length / 2
    parts = f.four_legs(width, length, tall, p.rectangle(post, post))
    for turned, (half, away) in ((90, (y, x)), (0, (x, y))):
        side: list[Mesh] = []
        if solid and not turned:
            side.append(p.box((2 * half, 0.025, tall - low), (0, away, low)))
        else:
            for z in (low, tall - 0.03):
                side.append(p.beam((-half, away, z), (half, away, z), (0.025, 0.05)))
            for bar in np.arange(pitch - half, half - 0.5 * pitch, pitch):
                side.append(p.rod((bar, away, low), (bar, away, tall - 0.03), 0.009, sides=6))
        parts += [p.turn(part, turned + half_turn) for part in side for half_turn in (0, 180)]
    parts.append(p.box((width - 0.02, length - 0.02, 0.02), (0, 0, deck - 0.02)))
    small = (width - 0.03, length - 0.03, deck, draw.between(0.1, 0.14))
    return parts + bedding(draw, *small, upright=False)


def bunk(draw: Draw) -> list[Mesh]:
    """Two beds over each other, or a loft bed, with guard rails and a ladder."""
    width, length, tall = draw.between(0.8, 1.0), draw.between(1.9, 2.05), draw.between(1.5, 1.8)
    post, high = draw.between(0.05, 0.09), draw.between(0.7, 0.78) * tall
    low = draw.between(0.22, 0.4)
    x, y, thick = width / 2 + post / 2, length / 2 + post / 2, draw.between(0.12, 0.18)
    parts = f.four_legs(2 * x, 2 * y, tall, p.rectangle(post, post))
    for level in [high] if draw.chance(0.25) else [low, high]:
        parts += f.both_sides(p.box((0.03, 2 * y, 0.14), (x, 0, level - 0.09)))
        parts.append(p.box((width, length, 0.02), (0, 0, level - 0.02)))
        rails = (level - 0.02, level + 0.22, level + min(0.42, tall - 0.06 - level))
        for s in (-1, 1):
            parts += [p.box((2 * x, 0.022, 0.08), (0, s * y, z - 0.04)) for z in rails]
        parts += bedding(draw, width, length, level, thick)
    for z in (high + 0.16, tall - 0.08):
        parts.append(p.box((0.022, 2 * y, 0.07), (-x, 0, z)))
        parts.append(p.box((0.022, 1.4 * y, 0.07), (x, 0.3 * y, z)))
    slope, rung, count = draw.pick(0.0, 0.0, 0.3), draw.between(0.28, 0.4), draw.count(4, 6)
    for s in (-1, 1):
        at = (x + slope + 0.03, -0.7 * y + s * rung / 2, 0)
        parts.append(p.frustum((0.05, 0.03), (0.05, 0.03), tall - 0.05, at, (-slope, 0)))
    for z in np.linspace(0, high, count + 1)[1:].tolist():
        step = (x + 0.03 + slope * (1 - z / (tall - 0.05)), -0.7 * y, z - 0.1)
        parts.append(p.box((0.06, rung, 0.03), step))
    return parts


def futon(draw: Draw) -> list[Mesh]:
    """A thick mat on the floor, on slats or on a base, without a headboard."""
    width, length = draw.pick(0.9, 1.2, 1.4, 1.6), draw.between(1.9, 2.1)
    base, parts, z = draw.pick("floor", "slats", "mat", "box"), [], 0.0
    if base == "slats":
        z, out = draw.between(0.08, 0.2), draw.between(0.0, 0.15)
        for x in (-0.42 * width, 0.0, 0.42 * width):
            parts.append(p.box((0.06, length + out, z - 0.02), (x, 0, 0)))
        for y in np.linspace(-0.5, 0.5, 14) * (length + out - 0.08):
            parts.append(p.box((width + out, 0.08, 0.02), (0, y, z - 0.02)))
    elif base == "mat":
        z = 0.05
        parts.append(p.box((width + 0.5, length + 0.3, z)))
    elif base == "box":
        z = draw.between(0.12, 0.3)
        parts.append(p.rounded_box((width + 0.02, length, z + 0.01), radius=0.04))
    return parts + bedding(draw, width, length, z, draw.between(0.1, 0.22), upright=False)


FAMILIES = families_of(train=(platform, iron, crib), test=(bunk, futon))
