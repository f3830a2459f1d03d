"""Chairs: dining, office, kitchen, bar, folding and upholstered ones."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue import parts as p
from qs3.meshes.catalogue.chair_metal import (
    bar_stool,
    cantilever,
    shell_chair,
    sled,
    swivel,
    wing_chair,
)
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.furniture import (
    ChairSize,
    back_cushion,
    both_sides,
    curved_panel,
    dining_size,
    four_legs,
    leg_section,
    post,
    rail_at,
)
from qs3.meshes.mesh import Mesh


def frame(size: ChairSize, section: np.ndarray, foot: float) -> list[Mesh]:
    """Two front legs and two rear ones that continue as the posts of the back."""
    x, y = size.width / 2 - 0.025, size.depth / 2 - 0.025
    front = post([(x, -y, 0), (x, -y, size.seat - 0.02)], section, [foot, 1.0])
    path = [
        (x, y + 0.05, 0),
        (x, size.back(size.seat), size.seat),
        (x, size.back(size.top), size.top),
    ]
    return [*both_sides(front), *both_sides(post(path, section, [foot, 1.0, 0.8]))]


def wooden_seat(draw: Draw, size: ChairSize) -> list[Mesh]:
    """A board or an upholstered pad at seat height, over four rails."""
    width, depth = size.width + 0.01, size.depth + 0.01
    if draw.chance(0.5):
        thick = draw.between(0.04, 0.07)
        at = (0, -0.005, size.seat - 0.02)
        top = p.rounded_box((width, depth, thick), at, 0.02, draw.between(0.0, 0.025))
    else:
        curve = p.rounded_rectangle(width, depth, draw.between(0.01, 0.06))
        top = p.slab(curve, 0.025, (0, -0.005, size.seat - 0.02))
    apron = draw.between(0.04, 0.08)
    rail = p.box((size.width - 0.06, size.depth - 0.06, apron), (0, 0, size.seat - 0.02 - apron))
    return [top, rail]


def stretchers(draw: Draw, size: ChairSize, radius: float) -> list[Mesh]:
    """Bars between the legs, or none."""
    if draw.chance(0.35):
        return []
    x, y, z = size.width / 2 - 0.025, size.depth / 2 - 0.025, draw.between(0.10, 0.24)
    bars = both_sides(p.rod((x, -y, z), (x, y + 0.02, z), radius))
    style = draw.pick("h", "box", "sides")
    if style == "h":
        bars.append(p.rod((-x, 0, z), (x, 0, z), radius))
    elif style == "box":
        bars += [p.rod((-x, s * y, z + 0.03), (x, s * y, z + 0.03), radius) for s in (-1, 1)]
    return bars


def four_legs_slats(draw: Draw) -> list[Mesh]:
    """A dining chair whose back has upright slats between two rails."""
    size = dining_size(draw)
    section = leg_section(draw.chance(0.3), draw.between(0.032, 0.045))
    out = frame(size, section, draw.between(0.65, 1.0)) + wooden_seat(draw, size)
    out += stretchers(draw, size, 0.011)
    low = size.seat + draw.between(0.06, 0.14)
    high = size.top - draw.between(0.07, 0.10)
    out += [rail_at(size, low, 0.045, 0.0), rail_at(size, high, size.top - high, 0.0)]
    slats = draw.count(3, 7)
    wide = draw.between(0.25, 0.6) * (size.width - 0.06) / slats
    for x in (np.arange(slats) - (slats - 1) / 2) * (size.width - 0.06) / slats:
        ends = [(x, size.back(z), z) for z in (low + 0.02, high + 0.02)]
        out.append(post(ends, p.rectangle(wide, 0.012)))
    return out


def four_legs_panel(draw: Draw) -> list[Mesh]:
    """A dining chair with a solid or padded back, sometimes covered down to the floor rail."""
    size = dining_size(draw)
    section = leg_section(draw.chance(0.3), draw.between(0.030, 0.045))
    tall = draw.chance(0.5)
    gap = 0.0 if tall else draw.between(0.08, 0.2)
    height = size.top - size.seat - gap
    out = wooden_seat(draw, size) + stretchers(draw, size, 0.011)
    if draw.chance(0.5):
        thick = draw.between(0.05, 0.08)
        at = (0, size.back(size.seat + gap) + 0.03, size.seat + gap)
        shape = (size.width + 0.01, thick, height)
        out.append(back_cushion(shape, at, rake=size.rake, crown=0.015, radius=0.025))
    else:
        out.append(rail_at(size, size.seat + gap, height, draw.between(0.0, 0.03), 0.022))
    return out + frame(size, section, draw.between(0.65, 1.0))


def ladder_back(draw: Draw) -> list[Mesh]:
    """A country chair: turned posts with finials, bowed rungs, a rush seat."""
    size = dining_size(draw)
    tall = ChairSize(
        size.width, size.depth, size.seat, size.top + draw.between(0.05, 0.15), size.rake
    )
    radius = draw.between(0.016, 0.021)
    out = frame(tall, p.ellipse(2 * radius, 2 * radius, 12), 0.9)
    rungs, bow = draw.count(3, 5), draw.between(0.01, 0.04)
    step = (tall.top - tall.seat - 0.06) / rungs
    high = draw.between(0.4, 0.65) * step
    out += [
        rail_at(tall, tall.seat + (k + 1) * step - high, high, bow, 0.014) for k in range(rungs)
    ]
    x = tall.width / 2 - 0.025
    if draw.chance(0.6):
        centre = (x, tall.back(tall.top) + 0.001, tall.top + 0.02)
        out += both_sides(p.ellipsoid((0.04, 0.04, 0.07), centre, sides=10, rings=5))
    seat = (tall.width + 0.02, tall.depth + 0.02, 0.045)
    out.append(p.rounded_box(seat, (0, 0, tall.seat - 0.04), 0.02))
    y = tall.depth / 2 - 0.025
    for z in (0.12, 0.24):
        out += both_sides(p.rod((x, -y, z), (x, y + 0.02, z), 0.010))
        out.append(p.rod((-x, -y, z + 0.04), (x, -y, z + 0.04), 0.010))
    return out


def armchair(draw: Draw) -> list[Mesh]:
    """A wooden easy chair: open arms, a seat cushion and a back cushion."""
    seat, rake = draw.between(0.36, 0.43), draw.between(12, 22)
    size = ChairSize(
        draw.between(0.54, 0.66),
        draw.between(0.52, 0.62),
        seat,
        seat + draw.between(0.38, 0.5),
        rake,
    )
    x, y = size.width / 2, size.depth / 2
    section = p.rectangle(draw.between(0.03, 0.05), draw.between(0.04, 0.06))
    rest = seat + draw.between(0.14, 0.2)
    thick = draw.between(0.09, 0.15)
    deck = seat - thick
    lean = draw.between(0.0, 0.06)
    foot = draw.between(0.6, 1.0)
    front = post([(x, -y - lean, 0), (x, -y, rest)], section, [foot, 1])
    rear = post([(x, y + 0.08, 0), (x, y, rest)], section, [foot, 1])
    arm = np.array([(x, -y - 0.04, rest + 0.012), (x, y + 0.06, rest - draw.between(0.0, 0.03))])
    out = [*both_sides(front), *both_sides(rear)]
    out += both_sides(p.sweep(p.rounded_rectangle(draw.between(0.045, 0.09), 0.026, 0.01, 2), arm))
    out.append(p.box((2 * x, size.depth, 0.05), (0, 0, deck - 0.05)))
    inside = 2 * x - 0.05
    out.append(p.rounded_box((inside, size.depth, thick), (0, -0.02, deck), 0.04, 0.02))
    height = size.top - deck - 0.02
    out.append(
        back_cushion(
            (inside, draw.between(0.09, 0.14), height), (0, y + 0.04, deck + 0.02), rake=rake
        )
    )
    out += [
        curved_panel(
            (inside, 0.025, 0.05),
            (0, y + 0.055 + (z - deck) * np.tan(np.radians(rake)), z),
            rake=rake,
        )
        for z in (deck + 0.1, deck + 0.28)
    ]
    return out


def spindle_back(draw: Draw) -> list[Mesh]:
    """A Windsor chair: a hoop filled with spindles on a thick seat, splayed turned legs."""
    width, depth = draw.between(0.42, 0.50), draw.between(0.40, 0.45)
    seat, rise, rake = draw.between(0.42, 0.46), draw.between(0.42, 0.58), draw.between(8, 14)
    outline = p.rounded_rectangle(width, depth, draw.between(0.12, 0.2), 6)
    out = [
        p.shell(outline, [(0.9, seat - 0.045), (1, seat - 0.025), (1, seat - 0.008), (0.96, seat)])
    ]
    for leg in four_legs(
        width * 0.6,
        depth * 0.6,
        seat - 0.03,
        p.ellipse(0.035, 0.035, 12),
        splay=draw.between(0.05, 0.09),
        foot=0.65,
    ):
        out.append(leg)
    z, reach = 0.2, 0.5 * 0.6 * width + 0.04
    out += both_sides(p.rod((reach, -reach, z), (reach, reach, z), 0.010))
    out.append(p.rod((-reach, 0, z), (reach, 0, z), 0.010))
    half = width / 2 - 0.035
    hoop = draw.chance(0.6)
    squareness = draw.between(0.45, 0.75)
    spindles = draw.count(5, 9)
    back: list[Mesh] = []
    if hoop:
        angle = np.linspace(0, np.pi, 25)
        path = np.column_stack(
            [half * np.cos(angle), 0 * angle, rise * np.sin(angle) ** squareness]
        )
        back.append(p.tube(path, 0.012))
    else:
        back += both_sides(p.rod((half, 0, -0.02), (half + 0.02, 0, rise - 0.05), 0.014))
        back.append(curved_panel((2 * half + 0.1, 0.022, 0.085), (0, 0, rise - 0.085), bow=0.0))
    for x in np.linspace(-0.78, 0.78, spindles) * half:
        top = rise * (1 - (x / half) ** 2) ** (squareness / 2) if hoop else rise - 0.04
        back.append(p.rod((0.85 * x, 0, -0.02), (x, 0, top), 0.007))
    return out + [p.move(p.turn(part, -rake, "x"), (0, depth / 2 - 0.045, seat)) for part in back]


def folding(draw: Draw) -> list[Mesh]:
    """Two crossing pairs of legs, a thin seat between them."""
    width, depth, seat = (
        draw.between(0.38, 0.46),
        draw.between(0.36, 0.42),
        draw.between(0.42, 0.46),
    )
    top = seat + draw.between(0.34, 0.44)
    wooden = draw.chance(0.5)
    section = p.rectangle(0.02, 0.035) if wooden else p.ellipse(0.024, 0.024, 8)
    x, y = width / 2, depth / 2
    out = both_sides(post([(x, -y - 0.05, 0), (x, y - 0.02, seat), (x, y + 0.07, top)], section))
    inner = x - 0.028
    out += both_sides(post([(inner, y + 0.1, 0), (inner, -y + 0.05, seat - 0.01)], section))
    out += [
        p.rod((-inner, y + 0.06, 0.08), (inner, y + 0.06, 0.08), 0.009),
        p.rod((-x, -y, 0.09), (x, -y, 0.09), 0.009),
    ]
    if wooden:
        boards = draw.count(4, 7)
        for k in range(boards):
            at = (0, -y + (k + 0.5) * depth / boards, seat - 0.01)
            out.append(p.box((width - 0.03, 0.8 * depth / boards, 0.016), at))
    else:
        out.append(p.rounded_box((width - 0.03, depth, 0.03), (0, 0, seat - 0.015), 0.012))
    rails = draw.count(1, 3)
    high = draw.between(0.05, 0.09) if rails > 1 else draw.between(0.14, 0.2)
    for k in range(rails):
        z = top - high - k * (high + 0.04)
        at = (0, y - 0.02 + 0.09 * (z - seat) / (top - seat), z)
        out.append(curved_panel((2 * x, 0.016, high), at, bow=0.015, rake=12))
    return out


FAMILIES: tuple[Family, ...] = (
    train(four_legs_slats),
    train(four_legs_panel),
    train(swivel),
    train(cantilever),
    train(armchair),
    train(shell_chair),
    train(spindle_back),
    train(bar_stool),
    test(ladder_back),
    test(sled),
    test(folding),
    test(wing_chair),
)
