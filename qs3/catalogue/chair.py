"""Chairs: dining, easy and office chairs, visitors' chairs of bent tube, upholstered ones."""

from dataclasses import dataclass

import numpy as np

from qs3.catalogue import furniture as f
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


@dataclass(frozen=True)
class ChairSize:
    """The measures of a dining chair, in metres; `seat` and `top` are heights above the floor."""

    width: float
    depth: float
    seat: float
    top: float
    rake: float

    def back(self, z: float) -> float:
        """The y of the back's middle plane at height z (above the seat)."""
        return self.depth / 2 - 0.02 + (z - self.seat) * float(np.tan(np.radians(self.rake)))

    def rail(self, z: float, height: float, bow: float, thickness: float = 0.02) -> Mesh:
        """A horizontal board between the posts of the back, its lower edge at height z."""
        shape = (self.width - 0.05, thickness, height)
        return f.curved_panel(shape, (0, self.back(z), z), bow=bow, rake=self.rake)


def dining_size(draw: Draw) -> ChairSize:
    """Measures of an ordinary dining or kitchen chair."""
    width, depth, seat = draw.between(0.4, 0.5), draw.between(0.4, 0.48), draw.between(0.42, 0.48)
    return ChairSize(width, depth, seat, seat + draw.between(0.36, 0.56), draw.between(4, 13))


def dining(draw: Draw) -> list[Mesh]:
    """Four legs, the rear ones up to the top; a back of slats, of rungs, of a board or padded."""
    size = dining_size(draw)
    section = f.leg_section(draw.chance(0.3), draw.between(0.03, 0.045))
    x, y, foot = size.width / 2 - 0.025, size.depth / 2 - 0.025, draw.between(0.65, 1.0)
    out = f.both_sides(f.post([(x, -y, 0), (x, -y, size.seat - 0.02)], section, [foot, 1.0]))
    rear = [(x, y + 0.05, 0), *((x, size.back(z), z) for z in (size.seat, size.top))]
    out += f.both_sides(f.post(rear, section, [foot, 1.0, 0.8]))
    apron, soft = draw.between(0.04, 0.08), draw.pick(0.025, draw.between(0.04, 0.07))
    at, low = (0, -0.005, size.seat - 0.02), size.seat - 0.02 - apron
    out.append(p.rounded_box((size.width + 0.01, size.depth + 0.01, soft), at, 0.02, soft - 0.025))
    out.append(p.box((size.width - 0.06, size.depth - 0.06, apron), (0, 0, low)))
    if draw.chance(0.65):
        z = draw.between(0.10, 0.24)
        out += f.both_sides(p.rod((x, -y, z), (x, y + 0.02, z), 0.011))
        if draw.chance(0.6):
            out.append(p.rod((-x, 0, z), (x, 0, z), 0.011))
    back = draw.pick("slats", "rungs", "board", "padded")
    gap = draw.between(0.06, 0.14) if back != "padded" else draw.pick(0.0, 0.12)
    low, tall = size.seat + gap, size.top - size.seat - gap
    if back == "slats":
        high = draw.between(0.07, 0.10)
        out += [size.rail(low, 0.045, 0.0), size.rail(size.top - high, high, 0.0)]
        slats, inner = draw.count(3, 7), size.width - 0.06
        flat = p.rectangle(draw.between(0.25, 0.6) * inner / slats, 0.012)
        for sx in (np.arange(slats) - (slats - 1) / 2) * inner / slats:
            ends = [(sx, size.back(z), z) for z in (low + 0.02, size.top - high + 0.02)]
            out.append(f.post(ends, flat))
    elif back == "rungs":
        rungs, bow = draw.count(2, 4), draw.between(0.01, 0.04)
        high = draw.between(0.4, 0.65) * tall / rungs
        for k in range(rungs):
            out.append(size.rail(low + (k + 1) * tall / rungs - high, high, bow, 0.014))
    elif back == "board":
        out.append(size.rail(low, tall, draw.between(0.0, 0.03), 0.022))
    else:
        shape, at = (size.width + 0.01, 0.065, tall), (0, size.back(low) + 0.03, low)
        out.append(f.back_cushion(shape, at, rake=size.rake, crown=0.015, radius=0.025))
    return out


def armchair(draw: Draw) -> list[Mesh]:
    """A wooden easy chair: open arms, a seat cushion and a back cushion."""
    seat, rake, thick = draw.between(0.36, 0.43), draw.between(12, 22), draw.between(0.09, 0.15)
    width, depth, rise = draw.between(0.54, 0.66), draw.between(0.52, 0.62), draw.between(0.38, 0.5)
    x, y, deck, rest = width / 2, depth / 2, seat - thick, seat + draw.between(0.14, 0.2)
    section = p.rectangle(draw.between(0.03, 0.05), draw.between(0.04, 0.06))
    foot = draw.between(0.6, 1.0)
    front = [(x, -y - draw.between(0.0, 0.06), 0), (x, -y, rest)]
    out = f.both_sides(f.post(front, section, [foot, 1]))
    out += f.both_sides(f.post([(x, y + 0.08, 0), (x, y, rest)], section, [foot, 1]))
    arm = np.array([(x, -y - 0.04, rest + 0.012), (x, y + 0.06, rest - draw.between(0.0, 0.03))])
    flat = p.rounded_rectangle(draw.between(0.045, 0.09), 0.026, 0.01, 2)
    out += f.both_sides(p.sweep(flat, arm))
    out.append(p.box((width, depth, 0.05), (0, 0, deck - 0.05)))
    inside, high = width - 0.05, thick + rise - 0.02
    out.append(p.rounded_box((inside, depth, thick), (0, -0.02, deck), 0.04, 0.02))
    shape = (inside, draw.between(0.09, 0.14), high)
    out.append(f.back_cushion(shape, (0, y + 0.04, deck + 0.02), rake=rake))
    for z in (0.1, 0.28):
        at = (0, y + 0.055 + z * np.tan(np.radians(rake)), deck + z)
        out.append(f.curved_panel((inside, 0.025, 0.05), at, rake=rake))
    return out


def swivel(draw: Draw) -> list[Mesh]:
    """An office chair on a five-spoked base with castors, mostly with arms."""
    width, depth = draw.between(0.44, 0.52), draw.between(0.42, 0.50)
    seat, reach, start = draw.between(0.42, 0.54), draw.between(0.27, 0.34), draw.between(0, 72)
    out: list[Mesh] = []
    for spoke in range(5):
        parts = [p.beam((0.02, 0, 0.11), (reach, 0, 0.075), (0.05, 0.035), 0.6)]
        for y in (-0.024, 0.004):
            parts.append(p.rod((reach, y, 0.028), (reach, y + 0.02, 0.028), 0.028))
        out += [p.turn(part, start + 72 * spoke) for part in parts]
    out += [
        p.lathe([(0.04, 0.08), (0.035, 0.16), (0.022, 0.17), (0.022, seat - 0.08)], sides=14),
        p.box((0.20, 0.24, 0.035), (0, 0.02, seat - 0.11)),
        p.rounded_box((width, depth, 0.09), (0, 0, seat - 0.08), 0.035, draw.between(0.0, 0.02)),
    ]
    gap, rake, rear = draw.between(0.02, 0.16), draw.between(6, 14), depth / 2 + 0.03
    wide, height = width * draw.between(0.78, 1.0), draw.between(0.34, 0.68)
    if draw.chance(0.5):
        shape = (wide, draw.between(0.05, 0.09), height)
        out.append(f.back_cushion(shape, (0, rear, seat + gap), rake=rake))
    else:
        at = (0, rear - 0.03, seat + gap)
        out.append(f.curved_panel((wide, 0.03, height), at, bow=0.04, rake=rake, radius=0.014))
    path = [(0, 0.05, -0.095), (0, rear + 0.015, -0.095), (0, rear + 0.06, gap + 0.2)]
    bracket = f.bent(list(np.add(path, (0, 0, seat))), 0.08)
    out.append(p.sweep(p.rectangle(0.06, 0.016), bracket))
    if draw.chance(0.65):
        x, rise, front = width / 2 + 0.03, seat + draw.between(0.18, 0.25), -draw.between(0.1, 0.16)
        loop = [(x, 0.1, seat - 0.08), (x, 0.14, rise), (x, front, rise)]
        if draw.chance(0.5):
            loop.append((x, front, seat - 0.08))
        section = p.rounded_rectangle(0.03, 0.045, 0.01, 2)
        out += f.both_sides(p.sweep(section, f.bent(loop, 0.05), up=(1, 0, 0)))
        out += f.both_sides(p.box((0.12, 0.3, 0.02), (width / 2 - 0.02, 0, seat - 0.09)))
    return out


def tube_chair(draw: Draw) -> list[Mesh]:
    """A visitor's chair of bent tube: on two runners, or springing from the front."""
    size = dining_size(draw)
    radius, x, y = draw.between(0.009, 0.013), size.width / 2 - 0.015, size.depth / 2
    low = size.seat - 0.03
    back = [(x, size.back(size.seat), low), (x, size.back(size.top), size.top - 0.03)]
    runners = draw.chance(0.5)
    side = [(x, y, radius), (x, -y - 0.01, radius), (x, -y - 0.01, low), *back]
    if runners:
        side = [(x, -y + 0.02, low), (x, -y - 0.02, radius), (x, y + 0.03, radius), *back]
    out = f.both_sides(p.tube(f.bent(side, 0.05), radius))
    if not runners:
        out.append(p.rod((-x, y, radius), (x, y, radius), radius))
    out += [p.rod((-x, s * y * 0.8, low), (x, s * y * 0.8, low), radius) for s in (-1, 1)]
    seat = (size.width, size.depth, draw.between(0.02, 0.06))
    out.append(p.rounded_box(seat, (0, -0.01, low), 0.015))
    height, bow = draw.between(0.18, 0.34), draw.between(0.0, 0.03)
    out.append(size.rail(size.top - height, height, bow, draw.between(0.015, 0.05)))
    if draw.chance(0.35):
        rest = size.seat + 0.2
        arm = [(x, size.back(rest), rest), (x, -y, rest), (x, -y, low)]
        out += f.both_sides(p.tube(f.bent(arm, 0.05), radius))
    return out


def wing_chair(draw: Draw) -> list[Mesh]:
    """A fully upholstered easy chair with a high back and, mostly, wings."""
    width, depth = draw.between(0.68, 0.82), draw.between(0.66, 0.78)
    foot = draw.between(0.08, 0.17)
    seat, top = draw.between(0.42, 0.48), draw.between(0.92, 1.12)
    arm, rest, rake = draw.between(0.09, 0.14), draw.between(0.58, 0.66), draw.between(6, 12)
    x, y, leg = width / 2 - arm / 2, depth / 2, f.leg_section(draw.chance(0.5), 0.045)
    out = f.four_legs(width - 0.12, depth - 0.12, foot + 0.01, leg, foot=0.6)
    out.append(p.rounded_box((width - 0.01, depth, seat - 0.12 - foot), (0, 0, foot), 0.02))
    cushion = (width - 2 * arm, depth - 0.12, 0.14)
    out.append(p.rounded_box(cushion, (0, -0.07, seat - 0.13), 0.04, 0.02))
    back, low = (width - arm, 0.14, top - foot - 0.06), (0, y, foot + 0.06)
    out.append(f.back_cushion(back, low, rake=rake, crown=0.03, radius=0.05))
    out += f.both_sides(p.rounded_box((arm, depth - 0.04, rest - foot), (x, -0.02, foot), 0.04))
    if draw.chance(0.75):
        lean, reach = (top - foot) * float(np.tan(np.radians(rake))), draw.between(0.14, 0.26)
        wing = [(y - 0.05, rest - 0.08), (y + lean - 0.06, top - 0.03)]
        wing += [(y - 0.1 - reach * 0.6, top - 0.07), (y - 0.1 - reach, rest + 0.12)]
        wing.append((y - 0.2 - reach, rest - 0.08))
        out += f.both_sides(p.move(p.extrude(wing, 0.06, "x"), (x - 0.03, 0, 0)))
    return out


FAMILIES = families_of(train=(dining, armchair, swivel), test=(tube_chair, wing_chair))
