"""Tables: dining, coffee, side and console tables, desks."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue import parts as p
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.furniture import (
    apron,
    both_sides,
    disc,
    drawer,
    four_legs,
    leg_section,
    plate,
    post,
)
from qs3.meshes.mesh import Mesh


def four_leg_table(draw: Draw) -> list[Mesh]:
    """A dining or kitchen table: a leg at each corner, mostly with an apron."""
    height, thick = draw.between(0.71, 0.78), draw.between(0.02, 0.05)
    depth = draw.between(0.70, 1.0)
    width = depth * draw.pick(1.0, 1.4, 1.8, 2.2) * draw.between(0.95, 1.1)
    leg, inset = draw.between(0.045, 0.10), draw.between(0.01, 0.08)
    section = leg_section(draw.chance(0.35), leg)
    x, y = width - 2 * inset - leg, depth - 2 * inset - leg
    under = height - thick
    out = [plate(draw, width, depth, height, thick)]
    out += four_legs(x, y, under + 0.005, section, foot=draw.between(0.55, 1.0))
    if draw.chance(0.8):
        out += apron(x, y, under, draw.between(0.06, 0.12))
    if draw.chance(0.2):
        z = draw.between(0.10, 0.18)
        out += both_sides(p.beam((x / 2, -y / 2, z), (x / 2, y / 2, z), (0.04, 0.05)))
        out.append(p.beam((-x / 2, 0, z), (x / 2, 0, z), (0.05, 0.04)))
    return out


def pedestal(draw: Draw) -> list[Mesh]:
    """A round, oval or square top on one column (two under a long one)."""
    height, thick = draw.between(0.70, 0.77), draw.between(0.02, 0.04)
    depth = draw.between(0.60, 1.20)
    shape = draw.pick("round", "round", "oval", "square")
    width = depth * (draw.between(1.3, 1.8) if shape == "oval" else 1.0)
    square = shape == "square"
    out = [(plate if square else disc)(draw, width, depth, height, thick)]
    radius, reach = draw.between(0.03, 0.06), 0.5 * depth * draw.between(0.5, 0.72)
    foot = draw.pick("disc", "trumpet", "claws")
    stem: list[Mesh] = []
    if foot == "claws":
        belly = radius * draw.between(1.2, 1.8)
        turned = [(radius, 0.12), (belly, 0.24), (radius, 0.36), (0.8 * radius, height - 0.15)]
        stem.append(p.lathe([*turned, (2 * radius, height - thick)], sides=18))
        claws = draw.count(3, 4)
        for k in range(claws):
            curve = p.arc((0, 0, 0.24), (0.6 * reach, 0, 0.26), (reach, 0, 0.025), 8)
            section = p.rounded_rectangle(0.055, 0.06, 0.015)
            claw = p.sweep(section, curve, scale=np.linspace(1, 0.6, 9))
            stem.append(p.turn(claw, 360 / claws * (k + 0.5)))
    else:
        flare = 0.10 if foot == "trumpet" else 0.03
        base = [(reach, 0), (reach, 0.012), (0.3 * reach + radius, 0.012 + flare * 0.3)]
        shaft = [(radius, 0.03 + flare * 2), (radius, height - thick - flare)]
        stem.append(p.lathe([*base, *shaft, (radius + flare, height - thick)], sides=28))
    apart = width / 4 if width > 1.5 else 0.0
    offsets = (-apart, apart) if apart else (0.0,)
    return out + [p.move(part, (dx, 0, 0)) for dx in offsets for part in stem]


def trestle(draw: Draw) -> list[Mesh]:
    """A top on two stands: A-shaped, or a column between a foot and a head."""
    height, thick = draw.between(0.71, 0.77), draw.between(0.02, 0.06)
    width, depth = draw.between(1.2, 2.3), draw.between(0.65, 0.95)
    x, under = width * draw.between(0.30, 0.40), height - thick
    bar_z = draw.between(0.14, 0.32)
    out = [plate(draw, width, depth, height, thick)]
    if draw.chance(0.5):
        spread, bar = depth * 0.38, draw.between(0.035, 0.055)
        slope = draw.between(0.05, 0.22)
        for s in (-1, 1):
            ends = [(x, s * spread, 0), (x, s * slope, under)]
            out += both_sides(post(ends, p.rectangle(bar, bar)))
        reach = spread + bar_z / under * (slope - spread)
        out += both_sides(p.beam((x, -reach, bar_z), (x, reach, bar_z), (0.03, 0.04)))
        out += both_sides(p.box((0.06, 0.84 * depth, 0.06), (x, 0, under - 0.06)))
    else:
        column = draw.between(0.06, 0.14)
        out += both_sides(p.frustum((0.09, depth * 0.75), (0.07, depth * 0.55), 0.07, (x, 0, 0)))
        head = p.frustum((0.07, depth * 0.5), (0.08, depth * 0.8), 0.06, (x, 0, under - 0.06))
        out += both_sides(head)
        y = 0.5 * column + 0.01
        for offset in (-y, y) if draw.chance(0.3) else (0.0,):
            out += both_sides(p.box((0.06, column, under - 0.08), (x, offset, 0.05)))
    if draw.chance(0.7):
        out.append(p.beam((-x - 0.06, 0, bar_z), (x + 0.06, 0, bar_z), (0.035, 0.09)))
    return out


def coffee(draw: Draw) -> list[Mesh]:
    """A low table, often with a glass top over a shelf."""
    height, width = draw.between(0.34, 0.50), draw.between(0.75, 1.3)
    depth = min(draw.between(0.45, 0.75), width)
    glass = draw.chance(0.5)
    thick = 0.010 if glass else draw.between(0.02, 0.06)
    leg, inset = draw.between(0.03, 0.08), draw.between(0.0, 0.06)
    x, y, under = width - 2 * inset - leg, depth - 2 * inset - leg, height - thick
    oval = draw.chance(0.25)
    if oval:
        x, y = 0.66 * x, 0.66 * y
    out = [(disc if oval else plate)(draw, width, depth, height, thick)]
    section = leg_section(draw.chance(0.4), leg)
    out += four_legs(x, y, under + 0.002, section, foot=draw.between(0.6, 1.0))
    if glass or draw.chance(0.5):
        out += apron(x + leg, y + leg, under, draw.between(0.02, 0.06))
    if draw.chance(0.75):
        z = draw.between(0.10, 0.18)
        out.append(p.box((x + 0.5 * leg, y + 0.5 * leg, 0.018), (0, 0, z)))
        for k in range(draw.count(0, 2)):  # magazines
            pile = (0.22, 0.29, draw.between(0.01, 0.04))
            at = (x * (0.25 - 0.5 * k), draw.between(-0.03, 0.03), z + 0.018)
            out.append(p.turn(p.box(pile, at), draw.between(-12, 12), "z", at))
    return out


def desk(draw: Draw) -> list[Mesh]:
    """A desk with a chest of drawers at one side or at both."""
    height, thick = draw.between(0.71, 0.77), draw.between(0.02, 0.035)
    width, depth = draw.between(1.05, 1.65), draw.between(0.55, 0.80)
    under, chest = height - thick, draw.between(0.32, 0.44)
    y, rear = -depth / 2 + 0.03, depth / 2 - 0.03
    out = [plate(draw, width, depth, height, thick)]
    knob = draw.pick("knob", "bar", "none")
    raised = draw.pick(0.0, 0.05, 0.12)
    rows = draw.count(2, 4)
    both = draw.chance(0.35)
    left = draw.pick(-1, 1)
    for side in (-1, 1) if both else (left,):
        x = side * (width / 2 - chest / 2 - 0.02)
        out.append(p.box((chest, rear - y, under - raised), (x, (rear + y) / 2, raised)))
        step = (under - raised - 0.02) / rows
        for k in range(rows):
            at = (x, y, raised + 0.01 + k * step)
            out += drawer(knob, (chest - 0.02, step - 0.012), at)
        if raised:
            feet = four_legs(chest - 0.06, rear - y - 0.06, raised + 0.01, p.rectangle(0.04, 0.04))
            out += [p.move(foot, (x, (rear + y) / 2, 0)) for foot in feet]
    if not both:
        x = -left * (width / 2 - 0.05)
        if draw.chance(0.5):
            out.append(p.box((0.03, rear - y, under), (x, (rear + y) / 2, 0)))
        else:
            leg = leg_section(draw.chance(0.5), 0.045)
            out += [
                post([(x, s, 0), (x, s, under)], leg, [0.8, 1.0]) for s in (y + 0.03, rear - 0.03)
            ]
    if draw.chance(0.6):
        low = draw.between(0.25, 0.5)
        out.append(p.box((width - 0.1, 0.018, under - low), (0, rear - 0.02, low)))
    if draw.chance(0.4):
        gap = width - chest * (2 if both else 1) - 0.12
        x = 0.0 if both else -left * (chest / 2 - 0.02)
        out.append(p.box((gap, rear - y, 0.09), (x, (rear + y) / 2, under - 0.09)))
        out += drawer(knob, (gap - 0.02, 0.075), (x, y, under - 0.085))
    return out


def side_table(draw: Draw) -> list[Mesh]:
    """A small table beside a sofa or a bed."""
    height, width = draw.between(0.42, 0.65), draw.between(0.34, 0.58)
    thick = draw.between(0.015, 0.035)
    under, is_round = height - thick, draw.chance(0.5)
    depth = width * (1.0 if is_round else draw.between(0.85, 1.15))
    out = [(disc if is_round else plate)(draw, width, depth, height, thick)]
    leg = draw.between(0.025, 0.045)
    section = leg_section(is_round or draw.chance(0.3), leg)
    splay, z = draw.between(0.0, 0.05), draw.between(0.12, 0.22)
    inner = 0.62 * width if is_round else width - leg - 0.02
    if is_round and draw.chance(0.5):
        for k in range(3):
            angle = np.radians(120 * k - 90)
            along = np.array([np.cos(angle), np.sin(angle), 0])
            ends = [(0.40 * width + splay) * along, 0.36 * width * along + (0, 0, under)]
            out.append(post(ends, section, [0.8, 1.0]))
    else:
        deep = inner if is_round else depth - leg - 0.02
        out += four_legs(inner, deep, under + 0.002, section, splay=splay * is_round, foot=0.8)
        if not is_round:
            high = draw.between(0.04, 0.16)
            out += apron(inner, deep, under, high)
            if high > 0.1:
                knob, at = draw.pick("knob", "bar"), (0, -deep / 2, under - high)
                out += drawer(knob, (inner - 0.04, high - 0.01), at)
    if draw.chance(0.6):
        make = disc if is_round else plate
        scale = 0.72 if is_round else 0.92
        out.append(make(draw, scale * width, scale * depth, z, 0.018))
    return out


def console(draw: Draw) -> list[Mesh]:
    """A narrow high table for a wall: a row of drawers, slender legs, mostly a low shelf."""
    height, width = draw.between(0.74, 0.90), draw.between(0.8, 1.4)
    depth = draw.between(0.28, 0.44)
    thick, high = draw.between(0.018, 0.035), draw.between(0.09, 0.17)
    leg = draw.between(0.03, 0.055)
    x, y, under = width - leg - 0.03, depth - leg - 0.02, height - thick
    out = [plate(draw, width, depth, height, thick)]
    out += four_legs(x, y, under, leg_section(draw.chance(0.3), leg), foot=draw.between(0.5, 1.0))
    out.append(p.box((x, y, high), (0, 0, under - high)))
    drawers, knob = draw.count(0, 3), draw.pick("knob", "bar")
    for k in range(drawers):
        front = (x - leg) / drawers
        at = ((k + 0.5) * front - (x - leg) / 2, -y / 2, under - high + 0.008)
        out += drawer(knob, (front - 0.012, high - 0.016), at)
    for z in (0.14, 0.42)[: draw.count(0, 2)]:
        out.append(p.box((x, y, 0.02), (0, 0, z)))
    return out


def crossed_legs(draw: Draw) -> list[Mesh]:
    """A top on two X-shaped frames, joined by a beam; some have picnic benches."""
    height, thick = draw.between(0.71, 0.77), draw.between(0.025, 0.055)
    width, depth = draw.between(1.1, 2.1), draw.between(0.62, 0.9)
    x, under = width * draw.between(0.32, 0.43), height - thick
    bar, spread = draw.between(0.035, 0.085), 0.42 * depth
    section = p.rectangle(draw.between(0.03, 0.06), bar)
    out = [plate(draw, width, depth, height, thick)]
    for s in (-1, 1):
        out += both_sides(post([(x, s * spread, 0), (x, -s * spread, under)], section))
    out.append(p.beam((-x, 0, under / 2), (x, 0, under / 2), (0.04, 0.06)))
    out += both_sides(p.box((0.05, 0.86 * depth, 0.04), (x, 0, under - 0.04)))
    if draw.chance(0.3):
        out += _benches(width, depth / 2 + 0.32, draw.between(0.40, 0.45), x)
    return out


def _benches(width: float, y: float, seat: float, x: float) -> list[Mesh]:
    """Two benches along the table, each at distance y, on beams through its frames."""
    x += 0.03
    out = both_sides(p.box((0.04, 2 * y + 0.16, 0.08), (x, 0, seat - 0.10)))
    for s in (-1, 1):
        out.append(p.box((width, 0.24, 0.035), (0, s * y, seat - 0.025)))
        leg = [(x, s * (y + 0.02), 0), (x, s * (y - 0.08), seat - 0.03)]
        out += both_sides(post(leg, p.rectangle(0.04, 0.08)))
    return out


def loop_frame(draw: Draw) -> list[Mesh]:
    """A top over two closed loops of flat steel: a loft, conference or low lounge table."""
    low = draw.chance(0.3)
    height = draw.between(0.36, 0.46) if low else draw.between(0.72, 0.76)
    width = draw.between(0.8, 1.2) if low else draw.between(1.3, 2.4)
    depth, thick = width * draw.between(0.4, 0.55), draw.between(0.022, 0.05)
    x, y, under = width / 2 - draw.between(0.08, 0.25), 0.5 * depth - 0.06, height - thick
    flat, waist = draw.between(0.03, 0.09), draw.between(0.55, 1.0)
    if draw.chance(0.3):  # the boat-shaped top of a conference table
        across = np.linspace(-1, 1, 13)
        edge = np.column_stack([across * width / 2, -depth / 2 * (1 - 0.22 * across**2)])
        out = [p.slab(np.concatenate([edge, -edge]), thick, (0, 0, under))]
        y *= 0.75
    else:
        out = [plate(draw, width, depth, height, thick)]
    corners = [(-y * waist, 0.012), (y * waist, 0.012), (y, under - 0.01), (-y, under - 0.01)]
    if draw.chance(0.5):
        corners[0], corners[1] = (-y, 0.012), (y, 0.012)
    for (y0, z0), (y1, z1) in zip(corners, corners[1:] + corners[:1], strict=True):
        bar = np.array([(x, y0, z0), (x, y1, z1)])
        out += both_sides(p.sweep(p.rectangle(0.024, flat), bar, up=(1, 0, 0)))
    return out


def drop_leaf(draw: Draw) -> list[Mesh]:
    """A narrow table whose two hinged leaves hang down or are held up by gates."""
    height, thick = draw.between(0.71, 0.76), draw.between(0.018, 0.028)
    depth, middle = draw.between(0.72, 0.95), draw.between(0.32, 0.55)
    drop, under = draw.between(0.36, 0.56), height - thick
    leg = draw.between(0.04, 0.06)
    x, y = middle - leg - 0.04, depth - leg - 0.16
    section = leg_section(draw.chance(0.6), leg)
    out = [p.box((middle, depth, thick), (0, 0, under))]
    out += four_legs(x, y, under, section, foot=0.7) + apron(x, y, under, 0.11)
    out += both_sides(p.beam((x / 2, -y / 2, 0.14), (x / 2, y / 2, 0.14), (0.025, 0.04)))
    t, power = np.linspace(-np.pi / 2, np.pi / 2, 25), draw.pick(0.2, 1.0)  # square or round leaf
    rim = np.sign(np.sin(t)) * np.abs(np.sin(t)) ** power * depth / 2
    leaf = p.extrude(np.column_stack([drop * np.abs(np.cos(t)) ** power, rim]), thick)
    hinge, gate = (middle / 2 + 0.004, 0, under), middle / 2 + 0.55 * drop
    up = draw.pick((), (1,), (-1, 1))
    for side in (-1, 1):
        if side in up:
            pieces = [
                p.move(leaf, hinge),
                post([(gate, 0, 0), (gate, 0, under)], section, [0.7, 1]),
            ]
            for z in (0.14, under - 0.06):
                pieces.append(p.beam((x / 2, 0, z), (gate, 0, z), (0.025, 0.04)))
        else:
            pieces = [p.move(p.turn(leaf, 88, "y"), hinge)]
        out += pieces if side > 0 else [p.mirrored(piece) for piece in pieces]
    return out


def splayed_round(draw: Draw) -> list[Mesh]:
    """A round or softly triangular top on slanting legs, in two heights."""
    low = draw.chance(0.5)
    height = draw.between(0.38, 0.50) if low else draw.between(0.71, 0.76)
    width = draw.between(0.55, 0.9) if low else draw.between(0.8, 1.15)
    legs, thick = draw.count(3, 4), draw.between(0.018, 0.035)
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    wobble = 1 + draw.pick(0.0, 0.0, 0.08) * np.cos(legs * (angle + np.pi / 2))
    curve = 0.5 * width * np.column_stack([np.cos(angle), np.sin(angle)]) * wobble[:, None]
    out = [p.slab(curve, thick, (0, 0, height - thick))]
    lean, size = draw.between(0.04, 0.13), draw.between(0.035, 0.055)
    for k in range(legs):
        turn = 2 * np.pi * k / legs - np.pi / 2
        along = np.array([np.cos(turn), np.sin(turn), 0])
        top = 0.5 * width * draw.between(0.58, 0.62) * along + (0, 0, height - thick)
        foot = top * (1, 1, 0) + lean * along
        out.append(post([foot, top], p.ellipse(size, size, 12), [0.55, 1.0]))
    if low and draw.chance(0.5):
        out.append(disc(draw, 0.6 * width, 0.6 * width, 0.17, 0.015))
    return out


FAMILIES: tuple[Family, ...] = (
    train(four_leg_table),
    train(pedestal),
    train(trestle),
    train(coffee),
    train(desk),
    train(side_table),
    train(console),
    test(crossed_legs),
    test(loop_frame),
    test(drop_leaf),
    test(splayed_round),
)
