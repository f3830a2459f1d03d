"""Lamps: floor and table lamps with shades, jointed, bent and spot lamps."""

import numpy as np

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


def shade(draw: Draw, width: float, z: float) -> list[Mesh]:
    """A drum, an empire or a cone open at both ends from the height z, its spider and its bulb."""
    t, height, lower = 0.006, width * draw.between(0.5, 0.85), 0.5 * width
    upper = lower * draw.pick(draw.between(0.88, 1.0), draw.between(0.5, 0.75), 0.35)
    profile = [(lower, 0), (upper, height), (upper - t, height), (lower - t, 0)]
    level, reach = z + 0.8 * height, lower + 0.8 * (upper - lower) - 0.5 * t
    spider = p.rod((-reach, 0, level), (reach, 0, level), 0.004, sides=6)
    parts = [p.lathe(profile, (0, 0, z), sides=28, loop=True), spider, p.turn(spider, 90)]
    return [*parts, bulb(level - 0.09)]


def bulb(z: float) -> Mesh:
    """An electric bulb that hangs; z is the middle of its glass."""
    profile = [(0.013, 0.11), (0.014, 0.06), (0.03, 0.02), (0.026, -0.01), (0, -0.028)]
    return p.lathe(profile, (0, 0, z), sides=12)


def hood(radius: float, height: float, neck: float, round_: bool) -> Mesh:
    """A reflector, closed above and open below; the mouth's centre is the origin."""
    outer = [(radius, 0.0), (0.5 * (radius + neck), 0.55 * height), (neck, 0.92 * height)]
    if round_:
        angles = np.linspace(0, 0.5 * np.pi, 6)[:-1]
        outer = [(radius * float(np.cos(a)), height * float(np.sin(a))) for a in angles]
    inner = [(max(r - 0.004, 0.3 * r), 0.96 * z) for r, z in outer[::-1]]
    return p.lathe([(0, 0.94 * height), *inner, *outer, (0, height)], sides=22)


def aim(mesh: Mesh, tilt: float, at: p.Vector) -> Mesh:
    """Turn a mouth that looks down by `tilt` degrees towards -y and place it."""
    return p.move(p.turn(mesh, -tilt, "x"), at)


def foot(draw: Draw, width: float) -> tuple[list[Mesh], float]:
    """A stand of one of several kinds, and the height at which the pole starts."""
    kind, r, h = draw.pick("disc", "dome", "square", "legs"), width / 2, draw.between(0.015, 0.035)
    if kind == "disc":
        return [p.cylinder(r, h, top=0.93 * r, sides=28)], h
    if kind == "dome":
        dome = [(r, 0), (r, 0.3 * h), (0.7 * r, 0.9 * h), (0.25 * r, 1.5 * h), (0.12 * r, 3 * h)]
        return [p.lathe(dome, sides=28)], 2.5 * h
    if kind == "square":
        return [p.slab(p.rounded_rectangle(1.8 * r, 1.8 * r, 0.2 * r), h)], h
    legs, top = draw.count(3, 4), 0.35 * width
    leg = p.tube(p.arc((0, 0, top), (0.5 * r, 0, top), (r, 0, 0), 6), 0.011)
    parts = [p.turn(leg, 360 / legs * k + 90) for k in range(legs)]
    return [*parts, p.cylinder(0.02, 0.06, (0, 0, top - 0.03))], top


def floor_shade(draw: Draw) -> list[Mesh]:
    """A pole or a tripod with a large shade."""
    height, width = draw.between(0.95, 1.4), draw.between(0.3, 0.52)
    cover = shade(draw, width, height)
    end = float(cover[1].bounds[1, 2])
    if draw.chance(0.35):
        thick, spread = draw.between(0.012, 0.02), height * draw.between(0.22, 0.32)
        top = (1.3 * thick, 0, height + 0.01)
        parts = [p.cylinder(2.2 * thick, 0.05, (0, 0, height - 0.03))]
        leg = p.rod(top, (spread, 0, 0), thick, 0.7 * thick)
        parts += [p.turn(leg, 90 + 120 * k) for k in range(3)]
        return [*parts, p.rod((0, 0, height), (0, 0, end), 0.008), *cover]
    parts, z = foot(draw, draw.between(0.24, 0.34))
    parts.append(p.cylinder(draw.between(0.008, 0.018), end - z + 0.005, (0, 0, z - 0.005)))
    if draw.chance(0.4):
        for level in np.linspace(0.25, 0.9, draw.count(1, 3)) * (height - z) + z:
            parts.append(p.ellipsoid((0.07, 0.07, draw.between(0.05, 0.12)), (0, 0, level)))
    return parts + cover


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
    curve = draw.pick(p.ellipse(2, 2, 24), p.ellipse(2, 2, 24), p.rounded_rectangle(2, 2, 0.3))
    main = p.shell(curve, [(belly * r, body * z) for r, z in shape])
    cover = shade(draw, width, body + draw.between(0.0, 0.04))
    neck = p.rod((0, 0, body - 0.02), (0, 0, cover[1].bounds[1, 2] + 0.002), 0.008)
    return [main, neck, *cover]


def desk_arm(draw: Draw) -> list[Mesh]:
    """Two arms with joints, a reflector at their end."""
    r, bar, twin = draw.between(0.07, 0.11), draw.between(0.005, 0.008), draw.chance(0.6)
    first, second = draw.between(0.25, 0.42), draw.between(0.25, 0.42)
    lean, dip = np.radians(draw.between(5, 35)), np.radians(draw.between(5, 60))
    hinge = np.array([0, 0, 0.06])
    elbow = hinge + first * np.array([0, np.sin(lean), np.cos(lean)])
    wrist = elbow + second * np.array([0, -np.cos(dip), np.sin(dip)])
    parts = [draw.pick(p.cylinder(r, 0.025, sides=24), p.box((2 * r, 1.7 * r, 0.03)))]
    parts.append(p.cylinder(0.014, 0.05, (0, 0, 0.015)))
    for side in (np.array([x, 0, 0]) for x in ((-0.012, 0.012) if twin else (0.0,))):
        parts.append(p.rod(hinge + side, elbow + side, bar, sides=6))
        parts.append(p.rod(elbow + side, wrist + side, bar, sides=6))
    half = np.array([0.022, 0, 0])
    parts += [p.rod(joint - half, joint + half, 0.016) for joint in (hinge, elbow, wrist)]
    radius, depth, tilt = draw.between(0.06, 0.1), draw.between(0.1, 0.16), draw.between(-10, 45)
    bell = p.move(hood(radius, depth, 0.025, draw.chance(0.3)), (0, 0, -depth))
    head = [bell, p.cylinder(0.02, 0.04, (0, 0, -0.02)), bulb(0.02 - depth * 0.75)]
    return parts + [aim(part, tilt, wrist) for part in head]


def spot_pole(draw: Draw) -> list[Mesh]:
    """A pole with two to four small spots on short arms."""
    height = draw.between(1.3, 1.75)
    parts, z = foot(draw, draw.between(0.22, 0.3))
    parts.append(p.cylinder(draw.between(0.009, 0.015), height - z, (0, 0, z - 0.005)))
    radius, depth = draw.between(0.04, 0.065), draw.between(0.11, 0.18)
    head = p.move(hood(radius, depth, 0.55 * radius, False), (0, 0, -0.6 * depth))
    for k in range(draw.count(2, 4)):
        level, heading = height - 0.05 - 0.21 * k, 140 * k + draw.between(-40, 40)
        end = (0, -draw.between(0.07, 0.13), level)
        parts.append(p.turn(p.rod((0, 0, level), end, 0.007), heading))
        parts.append(p.turn(aim(head, draw.between(25, 115), end), heading))
    return parts


def gooseneck(draw: Draw) -> list[Mesh]:
    """A bent tube over a foot, a bell at its end; for the desk or, large, next to a chair."""
    large = draw.chance(0.4)
    height = draw.between(1.15, 1.6) if large else draw.between(0.32, 0.5)
    reach = draw.between(0.25, 0.5) if large else draw.between(0.16, 0.28)
    r, bend = 0.13 if large else draw.between(0.07, 0.1), min(0.55 * height, 0.4)
    stem = p.arc((0, 0, height - bend), (0, 0, height + 0.45 * bend), (0, -0.7 * reach, height), 10)
    over, end = stem[-1] + (0, -0.3 * reach, -0.1 * bend), (0, -reach, height - 0.06)
    path = np.concatenate([[(0, 0, 0.015)], stem, p.arc(stem[-1], over, end, 3)[1:]])
    parts = [p.lathe([(r, 0), (r, 0.012), (0.6 * r, 0.03), (0.2 * r, 0.045)], sides=24)]
    parts.append(p.tube(path, 0.01 if large else 0.007))
    radius, depth = draw.between(0.07, 0.1) * (1.3 if large else 1), draw.between(0.1, 0.15)
    bell = p.move(hood(radius, depth, 0.03, draw.chance(0.5)), (0, 0, 0.01 - depth))
    return [*parts, aim(bell, draw.between(5, 40), end)]


FAMILIES = families_of(train=(floor_shade, table_shade, desk_arm), test=(spot_pole, gooseneck))
