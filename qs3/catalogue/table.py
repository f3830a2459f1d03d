"""Tables: dining, coffee, round and lounge tables, desks."""

import numpy as np

from qs3.catalogue import furniture as f
from qs3.catalogue import joinery as j
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


def plate(draw: Draw, width: float, depth: float, z: float, thick: float) -> Mesh:
    """A rectangular top whose upper face is at height z; its edge or its corners may be round."""
    at, style = (0, 0, z - thick), draw.pick("sharp", "corners", "round")
    if style == "corners":
        return p.slab(p.rounded_rectangle(width, depth, draw.between(0.03, 0.12), 5), thick, at)
    return p.rounded_box((width, depth, thick), at, (0.4 if style == "round" else 0.05) * thick)


def disc(draw: Draw, width: float, depth: float, z: float, thick: float) -> Mesh:
    """A round or oval top whose upper face is at height z, its edge softened."""
    edge = draw.between(0.1, 0.4) * thick
    low, inset = z - thick, 1 - 2 * edge / max(width, depth)
    profile = [(inset, low), (1, low + edge), (1, z - edge), (inset, z)]
    return p.shell(p.ellipse(width, depth, 40), profile)


def apron(width: float, depth: float, z: float, height: float) -> list[Mesh]:
    """Four boards under the top, outer measures width x depth, upper edge at z."""
    x, y, low = width / 2 - 0.01, depth / 2 - 0.01, z - height
    long = [p.box((width, 0.02, height), (0, s * y, low)) for s in (-1, 1)]
    return long + [p.box((0.02, depth, height), (s * x, 0, low)) for s in (-1, 1)]


def four_leg_table(draw: Draw) -> list[Mesh]:
    """A dining or kitchen table: a leg at each corner, mostly with an apron."""
    height, thick = draw.between(0.71, 0.78), draw.between(0.02, 0.05)
    depth = draw.between(0.70, 1.0)
    width = depth * draw.pick(1.0, 1.4, 1.8, 2.2) * draw.between(0.95, 1.1)
    leg, inset, under = draw.between(0.045, 0.10), draw.between(0.01, 0.08), height - thick
    x, y = width - 2 * inset - leg, depth - 2 * inset - leg
    section = f.leg_section(draw.chance(0.35), leg)
    out = [plate(draw, width, depth, height, thick)]
    out += f.four_legs(x, y, under + 0.005, section, foot=draw.between(0.55, 1.0))
    if draw.chance(0.8):
        out += apron(x, y, under, draw.between(0.06, 0.12))
    if draw.chance(0.2):
        z = draw.between(0.10, 0.18)
        out += f.both_sides(p.beam((x / 2, -y / 2, z), (x / 2, y / 2, z), (0.04, 0.05)))
        out.append(p.beam((-x / 2, 0, z), (x / 2, 0, z), (0.05, 0.04)))
    return out


def pedestal(draw: Draw) -> list[Mesh]:
    """A round, oval or square top on one column (two under a long one)."""
    height, thick, depth = draw.between(0.7, 0.77), draw.between(0.02, 0.04), draw.between(0.6, 1.2)
    shape = draw.pick("round", "round", "oval", "square")
    width = depth * (draw.between(1.3, 1.8) if shape == "oval" else 1.0)
    out = [(plate if shape == "square" else disc)(draw, width, depth, height, thick)]
    radius, reach = draw.between(0.03, 0.06), 0.5 * depth * draw.between(0.5, 0.72)
    stem: list[Mesh] = []
    if draw.chance(0.35):  # on claws
        belly = radius * draw.between(1.2, 1.8)
        turned = [(radius, 0.12), (belly, 0.24), (radius, 0.36), (0.8 * radius, height - 0.15)]
        stem.append(p.lathe([*turned, (2 * radius, height - thick)], sides=18))
        curve = p.arc((0, 0, 0.24), (0.6 * reach, 0, 0.26), (reach, 0, 0.025), 8)
        section = p.rounded_rectangle(0.055, 0.06, 0.015)
        claw, claws = p.sweep(section, curve, scale=np.linspace(1, 0.6, 9)), draw.count(3, 4)
        stem += [p.turn(claw, 360 / claws * (k + 0.5)) for k in range(claws)]
    else:
        flare = draw.pick(0.1, 0.03)
        base = [(reach, 0), (reach, 0.012), (0.3 * reach + radius, 0.012 + flare * 0.3)]
        shaft = [(radius, 0.03 + flare * 2), (radius, height - thick - flare)]
        stem.append(p.lathe([*base, *shaft, (radius + flare, height - thick)], sides=28))
    offsets = (-width / 4, width / 4) if width > 1.5 else (0.0,)
    return out + [p.move(part, (dx, 0, 0)) for dx in offsets for part in stem]


def coffee(draw: Draw) -> list[Mesh]:
    """A low table, often with a glass top over a shelf."""
    height, width = draw.between(0.34, 0.50), draw.between(0.5, 1.3)
    depth, glass, oval = min(draw.between(0.45, 0.75), width), draw.chance(0.5), draw.chance(0.25)
    thick = 0.010 if glass else draw.between(0.02, 0.06)
    leg, inset = draw.between(0.03, 0.08), draw.between(0.0, 0.06)
    x, y, under = width - 2 * inset - leg, depth - 2 * inset - leg, height - thick
    if oval:
        x, y = 0.66 * x, 0.66 * y
    out = [(disc if oval else plate)(draw, width, depth, height, thick)]
    section = f.leg_section(draw.chance(0.4), leg)
    out += f.four_legs(x, y, under + 0.002, section, foot=draw.between(0.6, 1.0))
    if glass or draw.chance(0.5):
        out += apron(x + leg, y + leg, under, draw.between(0.02, 0.06))
    if draw.chance(0.75):
        out.append(p.box((x + 0.5 * leg, y + 0.5 * leg, 0.018), (0, 0, draw.between(0.10, 0.18))))
    return out


def desk(draw: Draw) -> list[Mesh]:
    """A desk with a chest of drawers at one side or at both."""
    height, thick = draw.between(0.71, 0.77), draw.between(0.02, 0.035)
    width, depth = draw.between(1.05, 1.65), draw.between(0.55, 0.80)
    under, chest, raised = height - thick, draw.between(0.32, 0.44), draw.pick(0.0, 0.05, 0.12)
    deep, y, look = depth - 0.06, 0.03 - depth / 2, j.any_look(draw, "flat", "flat", "raised")
    rows, both, left = draw.count(2, 4), draw.chance(0.35), draw.pick(-1, 1)
    out = [plate(draw, width, depth, height, thick)]
    for side in (-1, 1) if both else (left,):
        x, step = side * (width / 2 - chest / 2 - 0.02), (under - raised) / rows
        out.append(p.box((chest, deep, under - raised), (x, 0, raised)))
        for k in range(rows):
            out += j.drawer(look, chest, step, deep, (x, y, raised + k * step))
        if raised:
            feet = f.four_legs(chest - 0.06, deep - 0.06, raised + 0.01, p.rectangle(0.04, 0.04))
            out += [p.move(foot, (x, 0, 0)) for foot in feet]
    if not both:
        x = -left * (width / 2 - 0.05)
        if draw.chance(0.5):
            out.append(p.box((0.03, deep, under), (x, 0, 0)))
        else:
            leg = f.leg_section(draw.chance(0.5), 0.045)
            out += [f.post([(x, s * y, 0), (x, s * y, under)], leg, [0.8, 1]) for s in (-0.9, 0.9)]
    if draw.chance(0.6):
        low = draw.between(0.25, 0.5)
        out.append(p.box((width - 0.1, 0.018, under - low), (0, -y - 0.02, low)))
    return out


def loop_frame(draw: Draw) -> list[Mesh]:
    """A top over two closed loops of flat steel: a loft or low lounge table."""
    low = draw.chance(0.3)
    height = draw.between(0.36, 0.46) if low else draw.between(0.72, 0.76)
    width = draw.between(0.8, 1.2) if low else draw.between(1.3, 2.4)
    depth, thick = width * draw.between(0.4, 0.55), draw.between(0.022, 0.05)
    x, y, under = width / 2 - draw.between(0.08, 0.25), 0.5 * depth - 0.06, height - thick
    flat, waist = draw.between(0.03, 0.09), draw.pick(1.0, draw.between(0.55, 1.0))
    out = [plate(draw, width, depth, height, thick)]
    corners = [(-y * waist, 0.012), (y * waist, 0.012), (y, under - 0.01), (-y, under - 0.01)]
    for (y0, z0), (y1, z1) in zip(corners, corners[1:] + corners[:1], strict=True):
        bar = np.array([(x, y0, z0), (x, y1, z1)])
        out += f.both_sides(p.sweep(p.rectangle(0.024, flat), bar, up=(1, 0, 0)))
    return out


def splayed_round(draw: Draw) -> list[Mesh]:
    """A round or softly triangular top on slanting legs, in two heights."""
    low = draw.chance(0.5)
    height = draw.between(0.38, 0.55) if low else draw.between(0.71, 0.76)
    width = draw.between(0.4, 0.9) if low else draw.between(0.8, 1.15)
    legs, thick = draw.count(3, 4), draw.between(0.018, 0.035)
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    wobble = 1 + draw.pick(0.0, 0.0, 0.08) * np.cos(legs * (angle + np.pi / 2))
    curve = 0.5 * width * np.column_stack([np.cos(angle), np.sin(angle)]) * wobble[:, None]
    out = [p.slab(curve, thick, (0, 0, height - thick))]
    lean, size, reach = draw.between(0.0, 0.13), draw.between(0.035, 0.055), 0.3 * width
    leg = f.post(
        [(reach + lean, 0, 0), (reach, 0, height - thick)], p.ellipse(size, size, 12), [0.55, 1]
    )
    out += [p.turn(leg, 360 / legs * k - 90) for k in range(legs)]
    if low and draw.chance(0.5):
        out.append(disc(draw, 0.66 * width, 0.66 * width, 0.17, 0.015))
    return out


FAMILIES = families_of(
    train=(four_leg_table, pedestal, coffee, desk),
    test=(loop_frame, splayed_round),
)
