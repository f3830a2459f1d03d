"""Chairs of metal, moulded shells and upholstery; `chair` lists them among the others."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue import parts as p
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.furniture import (
    back_cushion,
    bent,
    both_sides,
    curved_panel,
    dining_size,
    four_legs,
    leg_section,
    rail_at,
)
from qs3.meshes.mesh import Mesh


def swivel(draw: Draw) -> list[Mesh]:
    """An office chair on a five-spoked base with castors."""
    width, depth = draw.between(0.44, 0.52), draw.between(0.42, 0.50)
    seat, reach = draw.between(0.42, 0.54), draw.between(0.27, 0.34)
    out: list[Mesh] = []
    start = draw.between(0, 72)
    for spoke in range(5):
        angle = np.radians(start + 72 * spoke)
        along = np.array([np.cos(angle), np.sin(angle), 0])
        across = np.array([-along[1], along[0], 0])
        out.append(
            p.beam(0.02 * along + (0, 0, 0.11), reach * along + (0, 0, 0.075), (0.05, 0.035), 0.6)
        )
        for side in (-1, 1):
            wheel = reach * along + side * 0.014 * across + (0, 0, 0.028)
            out.append(p.rod(wheel - 0.010 * across, wheel + 0.010 * across, 0.028, sides=12))
    out += [
        p.lathe([(0.04, 0.08), (0.035, 0.16), (0.022, 0.17), (0.022, seat - 0.08)], sides=14),
        p.box((0.20, 0.24, 0.035), (0, 0.02, seat - 0.11)),
        p.rounded_box((width, depth, 0.09), (0, 0, seat - 0.08), 0.035, draw.between(0.0, 0.02)),
    ]
    gap, rake = draw.between(0.02, 0.16), draw.between(6, 14)
    height, thick = draw.between(0.34, 0.68), draw.between(0.03, 0.09)
    rear = depth / 2 + 0.03
    back_width = width * draw.between(0.78, 1.0)
    if draw.chance(0.5):
        out.append(back_cushion((back_width, thick, height), (0, rear, seat + gap), rake=rake))
    else:
        shape = (back_width, 0.03, height)
        at = (0, rear - 0.03, seat + gap)
        out.append(curved_panel(shape, at, bow=0.04, rake=rake, radius=0.014))
    bracket = bent(
        [
            (0, 0.05, seat - 0.095),
            (0, rear + 0.015, seat - 0.095),
            (0, rear + 0.06, seat + gap + 0.2),
        ],
        0.08,
    )
    out.append(p.sweep(p.rectangle(0.06, 0.016), bracket))
    if draw.chance(0.65):
        out += both_sides(_office_arm(draw, width / 2 + 0.03, seat))
        out += both_sides(p.box((0.12, 0.05, 0.02), (width / 2 - 0.02, 0.02, seat - 0.09)))
    return out


def _office_arm(draw: Draw, x: float, seat: float) -> Mesh:
    """One arm as a bent loop, from below the seat up and over."""
    rise = draw.between(0.18, 0.25)
    front, rear = -draw.between(0.10, 0.16), draw.between(0.10, 0.16)
    points = [(x, 0.02, seat - 0.08), (x, 0.06, seat + rise), (x, front, seat + rise)]
    if draw.chance(0.5):
        points = [
            (x, rear, seat - 0.08),
            (x, rear, seat + rise),
            (x, front, seat + rise),
            (x, front, seat - 0.08),
        ]
    return p.sweep(p.rounded_rectangle(0.03, 0.045, 0.01, 2), bent(points, 0.05), up=(1, 0, 0))


def cantilever(draw: Draw) -> list[Mesh]:
    """A tube that runs along the floor, up in front, under the seat and up the back."""
    size = dining_size(draw)
    radius, x = draw.between(0.010, 0.014), size.width / 2
    front, rear = -size.depth / 2 - 0.01, size.depth / 2
    top = (x, size.back(size.top), size.top - 0.01)
    side = [
        (x, front, radius),
        (x, front, size.seat - 0.03),
        (x, size.back(size.seat), size.seat - 0.03),
        top,
    ]
    floor = [(x, rear, radius)]
    right = floor + side
    left = [(-a, b, c) for a, b, c in right][::-1]
    out: list[Mesh]
    if draw.chance(0.6):
        out = [p.tube(bent([*left, *right], 0.05, 4), radius)]  # joined behind, on the floor
    else:
        out = [p.tube(bent([*right[::-1][:-1], *left[::-1][1:]], 0.05, 4), radius)]  # in front
        out.append(p.tube(np.array([(-x, rear, radius), (x, rear, radius)]), radius))
        out += both_sides(p.rod((x, front + 0.03, radius), (x, rear, radius), radius))
    thick = draw.between(0.02, 0.06)
    seat = (size.width - 0.01, size.depth, thick)
    out.append(p.rounded_box(seat, (0, -0.01, size.seat - 0.025), 0.015))
    height = (size.top - size.seat) * draw.between(0.5, 0.85)
    z = size.top - height
    out.append(rail_at(size, z, height, draw.between(0.0, 0.03), draw.between(0.015, 0.05)))
    if draw.chance(0.4):
        rest = size.seat + draw.between(0.17, 0.22)
        arm = bent(
            [(x, size.back(rest), rest), (x, front + 0.04, rest), (x, front, size.seat - 0.05)],
            0.06,
        )
        out += both_sides(p.tube(arm, radius))
    return out


def shell_chair(draw: Draw) -> list[Mesh]:
    """A moulded shell on splayed wooden legs, a wire base or a trumpet foot."""
    width, depth, seat = (
        draw.between(0.44, 0.54),
        draw.between(0.38, 0.44),
        draw.between(0.43, 0.47),
    )
    rise = draw.between(0.34, 0.42)
    y = depth / 2
    path = bent(
        [
            (0, -y - 0.02, seat - 0.02),
            (0, -y + 0.06, seat + 0.01),
            (0, y - 0.01, seat - 0.01),
            (0, y + 0.12, seat + rise),
        ],
        0.16,
        8,
    )
    across = np.linspace(-0.5, 0.5, 13)
    edge = 4 * draw.between(0.02, 0.07) * across**2
    upper, lower = (
        np.column_stack([across * width, edge + 0.006]),
        np.column_stack([across * width, edge - 0.006]),
    )
    t = np.linspace(0, 1, len(path))
    scale = 1 - draw.between(0.1, 0.35) * np.abs(2 * t - 0.9) ** 3
    out = [p.sweep(np.concatenate([lower, upper[::-1]]), path, scale=scale)]
    base = draw.pick("wood", "wire", "trumpet")
    if base == "trumpet":
        profile = [
            (0.24, 0),
            (0.235, 0.012),
            (0.12, 0.03),
            (0.04, 0.09),
            (0.025, 0.22),
            (0.05, seat),
        ]
        return [*out, p.lathe(profile, sides=28)]
    round_leg = p.ellipse(0.034, 0.034, 12) if base == "wood" else p.ellipse(0.014, 0.014, 8)
    out += four_legs(
        width * 0.5,
        depth * 0.55,
        seat + 0.012,
        round_leg,
        splay=0.10,
        foot=0.7 if base == "wood" else 1,
    )
    z = seat - draw.between(0.08, 0.14)
    a, b = width * 0.25 + 0.02, depth * 0.28 + 0.02
    out += [p.rod((-a, -b, z), (a, b, z), 0.006), p.rod((-a, b, z), (a, -b, z), 0.006)]
    return out


def bar_stool(draw: Draw) -> list[Mesh]:
    """A high stool on splayed legs or on one column, with a low back or none."""
    seat, width = draw.between(0.60, 0.80), draw.between(0.34, 0.42)
    round_seat = draw.chance(0.5)
    out: list[Mesh] = []
    thick = draw.between(0.03, 0.08)
    if round_seat:
        bulge = 0.4 * thick
        profile = [
            (0, seat - thick),
            (width / 2 - 0.01, seat - thick),
            (width / 2, seat - bulge),
            (width / 2 - 0.015, seat),
            (0, seat + 0.005),
        ]
        out.append(p.lathe(profile, sides=28))
    else:
        out.append(p.rounded_box((width, width * 0.95, thick), (0, 0, seat - thick), 0.02, 0.01))
    rest = draw.between(0.2, 0.3)
    if draw.chance(0.5):
        splay = draw.between(0.02, 0.07)
        section = leg_section(round_seat, draw.between(0.026, 0.038))
        inner = width * (0.62 if round_seat else 0.86)
        out += four_legs(inner, inner, seat - 0.02, section, splay=splay, foot=0.85)
        reach = inner / 2 + splay * (1 - rest / seat)
        for k, (a, b) in enumerate([(-1, -1), (1, -1), (1, 1), (-1, 1)]):
            z = rest + 0.04 * (k % 2)
            out.append(p.rod((a * reach, b * reach, z), (-b * reach, a * reach, z), 0.010))
    else:
        base = draw.between(0.18, 0.23)
        out.append(
            p.lathe(
                [(base, 0), (base, 0.012), (0.05, 0.03), (0.026, 0.06), (0.026, seat - 0.02)],
                sides=28,
            )
        )
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = np.column_stack(
            [0.15 * np.cos(angle), 0.15 * np.sin(angle) - 0.05, np.full(24, rest + 0.05)]
        )
        out += [
            p.tube(ring, 0.011, loop=True),
            p.rod((0, 0, rest + 0.05), (0, -0.2, rest + 0.05), 0.011),
        ]
    if draw.chance(0.6):
        high = draw.between(0.16, 0.32)
        out.append(
            curved_panel(
                (width * 0.95, 0.02, high * 0.6),
                (0, width / 2, seat + high * 0.4),
                bow=0.03,
                rake=8,
            )
        )
        x = width * 0.3
        out += both_sides(
            p.rod(
                (x, width / 2 - 0.05, seat - 0.02), (x, width / 2 + 0.025, seat + high * 0.6), 0.010
            )
        )
    return out


def sled(draw: Draw) -> list[Mesh]:
    """A stacking visitor chair: bent tube runners on the floor at either side."""
    size = dining_size(draw)
    radius, x, y = draw.between(0.009, 0.013), size.width / 2 - 0.01, size.depth / 2
    low = size.seat - 0.03
    top = (x * 0.9, size.back(size.top), size.top - 0.03)
    runner = [
        (x * 0.9, -y + 0.02, low),
        (x, -y - 0.02, radius),
        (x, y + 0.03, radius),
        (x * 0.9, size.back(size.seat), low),
        top,
    ]
    out = both_sides(p.tube(bent(runner, 0.05), radius))
    out += [p.rod((-x, s * y * 0.8, low), (x, s * y * 0.8, low), radius) for s in (-1, 1)]
    out.append(
        p.rounded_box((size.width, size.depth, draw.between(0.02, 0.05)), (0, -0.01, low), 0.015)
    )
    height = draw.between(0.18, 0.34)
    out.append(
        rail_at(size, size.top - height, height, draw.between(0.0, 0.03), draw.between(0.015, 0.04))
    )
    if draw.chance(0.3):
        rest = size.seat + 0.2
        arm = [(x, size.back(rest), rest), (x, -y, rest), (x, -y, low)]
        out += both_sides(p.tube(bent(arm, 0.05), radius))
    return out


def wing_chair(draw: Draw) -> list[Mesh]:
    """A fully upholstered easy chair with a high back and, mostly, wings."""
    width, depth = draw.between(0.68, 0.82), draw.between(0.66, 0.78)
    seat, top = draw.between(0.42, 0.48), draw.between(0.92, 1.12)
    arm, rest, rake = draw.between(0.09, 0.14), draw.between(0.58, 0.66), draw.between(6, 12)
    foot = draw.between(0.08, 0.17)
    inside, y = width - 2 * arm, depth / 2
    out = four_legs(
        width - 0.12, depth - 0.12, foot + 0.01, leg_section(draw.chance(0.5), 0.045), foot=0.6
    )
    out.append(p.rounded_box((width - 0.01, depth, seat - 0.12 - foot), (0, 0, foot), 0.02))
    out.append(p.rounded_box((inside, depth - 0.12, 0.14), (0, -0.07, seat - 0.13), 0.04, 0.02))
    out.append(
        back_cushion(
            (width - arm, 0.14, top - foot - 0.06),
            (0, y, foot + 0.06),
            rake=rake,
            crown=0.03,
            radius=0.05,
        )
    )
    at = (width / 2 - arm / 2, -0.02, foot)
    out += both_sides(p.rounded_box((arm, depth - 0.04, rest - foot), at, 0.04))
    if draw.chance(0.75):
        lean = float(np.tan(np.radians(rake)))
        reach = draw.between(0.14, 0.26)
        wing = [
            (y - 0.05, rest - 0.08),
            (y + (top - foot) * lean - 0.06, top - 0.03),
            (y - 0.1 - reach * 0.6, top - 0.07),
            (y - 0.1 - reach, rest + 0.12),
            (y - 0.2 - reach, rest - 0.08),
        ]
        plate = p.extrude(wing, 0.06, "x")
        out += both_sides(p.move(plate, (width / 2 - arm / 2 - 0.03, 0, 0)))
    return out
