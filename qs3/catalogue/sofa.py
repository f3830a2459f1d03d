"""Sofas: cushioned, L-shaped, buttoned, with an open frame, curved, folding; front along -y."""

from dataclasses import dataclass

import numpy as np

from qs3.catalogue import furniture as f
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.meshes.mesh import Mesh


@dataclass(frozen=True)
class SofaSize:
    """The measures every sofa has, in metres; `foot`, `seat`, `rest` and `top` are heights."""

    seats: int
    inside: float
    depth: float
    arm: float
    foot: float
    seat: float
    rest: float
    top: float

    @property
    def width(self) -> float:
        """Over both arms."""
        return self.inside + 2 * self.arm


def sofa_size(draw: Draw, seats: int) -> SofaSize:
    """Measures of a sofa for so many people."""
    seat = draw.between(0.40, 0.47)
    return SofaSize(
        seats=seats,
        inside=seats * draw.between(0.55, 0.72),
        depth=draw.between(0.80, 0.98),
        arm=draw.between(0.10, 0.24),
        foot=draw.between(0.02, 0.15),
        seat=seat,
        rest=seat + draw.between(0.13, 0.24),
        top=seat + draw.between(0.32, 0.50),
    )


def feet(draw: Draw, width: float, depth: float, height: float) -> list[Mesh]:
    """Legs near the corners, or a recessed plinth when low."""
    if height < 0.05:
        return [p.box((width - 0.1, depth - 0.1, height + 0.01), (0, 0, 0))]
    section = f.leg_section(draw.chance(0.5), draw.between(0.04, 0.07))
    return f.four_legs(
        width - 0.16, depth - 0.16, height + 0.01, section, foot=draw.between(0.5, 1)
    )


def seat_cushions(size: SofaSize, thick: float, front: float, rear: float) -> list[Mesh]:
    """A row of seat cushions between the arms, from y = front to y = rear."""
    wide, middle = size.inside / size.seats, ((front + rear) / 2, size.seat - thick)
    shape = (wide - 0.006, rear - front, thick)
    places = [(k + 0.5) * wide - size.inside / 2 for k in range(size.seats)]
    return [p.rounded_box(shape, (x, *middle), 0.04, 0.02) for x in places]


def back_cushions(draw: Draw, size: SofaSize, thick: float, rear: float, rake: float) -> list[Mesh]:
    """A row of back cushions on the seat; `rear` is the y of their rear face at seat height.

    None to three loose pillows lean on them.
    """
    wide, crown = size.inside / size.seats, draw.between(0.03, 0.06)
    shape = (wide - 0.01, thick, size.top - size.seat + draw.between(-0.03, 0.06))
    out = []
    for k in range(size.seats):
        at = ((k + 0.5) * wide - size.inside / 2, rear, size.seat - 0.01)
        out.append(f.back_cushion(shape, at, rake=rake, crown=crown, radius=0.055))
    for _ in range(draw.count(0, 3)):
        side, x = draw.between(0.36, 0.48), draw.between(-0.5, 0.5) * (size.inside - 0.48)
        lying = p.turn(p.pillow((side, side, 0.13), (0, 0, -0.065)), draw.between(-15, 15))
        upright = p.turn(lying, 90 - draw.between(12, 28), "x")
        out.append(p.move(upright, (x, rear - thick - 0.13, size.seat + 0.46 * side)))
    return out


def cushioned(draw: Draw) -> list[Mesh]:
    """The common sofa: box arms, cushions for seat and back; the last seat may be drawn out."""
    size = sofa_size(draw, draw.pick(1, 2, 2, 3, 3))
    y, shell, thick = size.depth / 2, draw.between(0.10, 0.16), draw.between(0.12, 0.18)
    rear, deck, x = y - shell, size.seat - thick, size.inside / 2 + size.arm / 2
    out = feet(draw, size.width, size.depth, size.foot)
    base = (size.width - 0.02, size.depth - 0.02, deck - size.foot)
    out.append(p.rounded_box(base, (0, 0, size.foot), 0.02))
    arm, soft = (size.arm, size.depth, size.rest - size.foot), draw.between(0.02, 0.08)
    out += f.both_sides(p.rounded_box(arm, (x, 0, size.foot), soft))
    back = (size.inside + 0.02, shell, size.top - 0.04 - size.foot)
    out.append(p.rounded_box(back, (0, y - shell / 2, size.foot), 0.04))
    out += seat_cushions(size, thick, -y - 0.01, rear)
    out += back_cushions(draw, size, draw.between(0.12, 0.18), rear - 0.03, draw.between(4, 12))
    if size.seats > 1 and draw.chance(0.35):  # an L, to the left or to the right
        wide, reach = size.inside / size.seats + size.arm, draw.between(0.55, 0.85)
        at = (draw.pick(-1, 1) * (size.width / 2 - wide / 2), 0.03 - y - reach / 2)
        out.append(p.rounded_box((wide, reach + 0.1, deck), (*at, 0), 0.02))
        out.append(p.rounded_box((wide, reach, thick), (*at, deck), 0.04, 0.02))
    return out


def loveseat(draw: Draw) -> list[Mesh]:
    """A small sofa with a tight back, one seat cushion and slender tapered legs."""
    size = sofa_size(draw, draw.pick(1, 2, 2))
    y, foot, arm = size.depth / 2 - 0.04, draw.between(0.12, 0.2), draw.between(0.08, 0.14)
    width, section = size.inside + 2 * arm, f.leg_section(True, draw.between(0.035, 0.05))
    deck = size.seat - draw.between(0.10, 0.15)
    out = f.four_legs(width - 0.2, 2 * y - 0.16, foot + 0.01, section, splay=0.04, foot=0.5)
    out.append(p.rounded_box((width - 0.02, 2 * y, deck - foot), (0, 0, foot), 0.03))
    cushion = (size.inside, 2 * y - 0.1, size.seat - deck)
    out.append(p.rounded_box(cushion, (0, -0.05, deck), 0.04, 0.02))
    back, rake = (width - arm * draw.pick(0.0, 1.4), 0.13, size.top - foot), draw.between(6, 13)
    out.append(f.back_cushion(back, (0, y, foot), rake=rake, crown=0.03, radius=0.05))
    side = p.rounded_box((arm, 2 * y - 0.04, size.rest - foot), (0, 0.01, 0), 0.45 * arm)
    leaning = p.turn(side, draw.between(0, 8), "y")
    return out + f.both_sides(p.move(leaning, (width / 2 - arm / 2, 0, foot)))


def roll(length: float, radius: float) -> Mesh:
    """A padded roll along y with rounded ends, about the origin."""
    t = np.array([-0.5, -0.49, -0.46, 0.46, 0.49, 0.5])
    path = np.column_stack([0 * t, t * length, 0 * t])
    return p.tube(path, radius, scale=[0.7, 0.92, 1, 1, 0.92, 0.7], sides=18)


def chesterfield(draw: Draw) -> list[Mesh]:
    """Arms and back are one roll of equal height; low feet."""
    size = sofa_size(draw, draw.count(2, 3))
    radius, foot, top = draw.between(0.075, 0.11), draw.between(0.06, 0.11), draw.between(0.7, 0.8)
    x, y, thick = size.inside / 2 + radius, size.depth / 2, draw.between(0.12, 0.16)
    out = feet(draw, 2 * x + radius, size.depth, foot)
    base = (2 * x, size.depth - 0.05, size.seat - thick - foot)
    out.append(p.rounded_box(base, (0, 0, foot), 0.03))
    out += seat_cushions(size, thick, -y - 0.01, y - 0.18)
    wall, tall = 1.5 * radius, top - radius - foot
    out += f.both_sides(p.rounded_box((wall, size.depth - 0.04, tall), (x, 0, foot), 0.03))
    out += f.both_sides(p.move(roll(size.depth + 0.02, radius), (x + 0.02, 0, top - radius)))
    out.append(p.rounded_box((2 * x, wall + 0.04, tall), (0, y - 0.1, foot), 0.03))
    across = p.turn(roll(2 * x + radius, radius), 90)
    out.append(p.move(across, (0, y - 0.07, top - radius)))
    return out


def open_frame(draw: Draw) -> list[Mesh]:
    """A Scandinavian sofa: a slender wooden frame with open arms carries loose cushions."""
    size = sofa_size(draw, draw.count(1, 3))
    x, y = size.inside / 2 + 0.03, size.depth / 2 - 0.06
    deck, rake = size.seat - draw.between(0.11, 0.15), draw.between(12, 20)
    section = f.leg_section(draw.chance(0.5), draw.between(0.04, 0.055))
    lean, drop = draw.between(0.0, 0.07), draw.between(0.0, 0.05)
    out = f.both_sides(f.post([(x, -y - lean, 0), (x, -y, size.rest)], section, [0.65, 1]))
    rear = [(x, y + 0.06, 0), (x, y, size.rest - drop)]
    out += f.both_sides(f.post(rear, section, [0.65, 1]))
    arm = np.array([(x, -y - 0.06, size.rest), (x, y + 0.1, size.rest - drop)])
    out += f.both_sides(p.sweep(p.rounded_rectangle(0.07, 0.03, 0.012, 2), arm))
    out.append(p.box((2 * x, 2 * y, 0.05), (0, 0, deck - 0.05)))
    out += seat_cushions(size, size.seat - deck, -y - 0.03, y - 0.08)
    slope = float(np.tan(np.radians(rake)))
    for z in np.linspace(deck + 0.06, size.top - 0.08, 4):
        at = y - 0.04 + slope * (z - deck)
        out.append(p.beam((-x, at, z), (x, at, z), (0.02, 0.05)))
    for s in np.linspace(-1, 1, size.seats + 1):
        path = [(s * x, y - 0.04 + slope * (z - deck), z) for z in (deck - 0.03, size.top - 0.03)]
        out.append(f.post(path, p.rectangle(0.04, 0.035)))
    return out + back_cushions(draw, size, 0.12, y - 0.07 + slope * (size.seat - deck), rake)


def curved(draw: Draw) -> list[Mesh]:
    """A kidney-shaped club sofa: a bowed seat in the arm of a bowed, tub-like back."""
    radius, sweep = draw.between(0.9, 1.5), draw.between(50, 75)
    depth, seat, top = draw.between(0.55, 0.68), draw.between(0.40, 0.46), draw.between(0.68, 0.84)
    foot, thick = draw.between(0.03, 0.14), draw.between(0.16, 0.26)
    angle = np.radians(np.linspace(90 - sweep, 90 + sweep, 25))
    unit = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    ends, out = [0.86, *[1.0] * 23, 0.86], []
    for wide, low, high, r in (
        (depth - 0.04, foot, seat - 0.14, radius - depth / 2),
        (depth, seat - 0.16, seat, radius - depth / 2),
        (thick, foot, top, radius + thick / 2 - 0.04),
    ):
        section = p.rounded_rectangle(wide, high - low, min(0.45 * wide, 0.07), 3)
        out.append(p.sweep(section, unit * r + (0, 0, (low + high) / 2), scale=ends))
    for k in (2, 12, 22):
        for r in (radius, radius - depth + 0.1):
            out.append(p.cylinder(0.025, foot + 0.02, unit[k] * r))
    return [p.move(part, (0, -radius * 0.75, 0)) for part in out]


def sofa_bed(draw: Draw) -> list[Mesh]:
    """A low folding sofa without fixed arms: mattress halves, the back at any angle."""
    width, depth = draw.between(1.7, 2.05), draw.between(0.58, 0.72)
    seat, thick = draw.between(0.36, 0.43), draw.between(0.12, 0.18)
    foot, rise, rake = draw.between(0.12, 0.18), draw.between(0.44, 0.56), draw.between(12, 30)
    out = f.four_legs(width - 0.24, depth - 0.1, foot + 0.02, f.leg_section(True, 0.04), foot=0.7)
    out.append(p.box((width - 0.1, depth - 0.06, seat - thick - foot), (0, 0, foot)))
    pads = draw.count(1, 3)
    wide, y = width / pads, depth / 2 + 0.6 * thick
    for k in range(pads):
        x, shape = (k + 0.5) * wide - width / 2, (wide - 0.004, thick, rise)
        lying = (wide - 0.004, depth, thick)
        out.append(p.rounded_box(lying, (x, 0, seat - thick), 0.035, 0.015))
        at = (x, y, seat - 0.08)
        out.append(f.back_cushion(shape, at, rake=rake, crown=0.015, radius=0.035))
    if draw.chance(0.5):
        bolster = p.move(roll(0.9 * depth, 0.09), (width / 2 - 0.12, 0, seat + 0.08))
        out += f.both_sides(bolster)
    return out


FAMILIES = families_of(
    train=(cushioned, loveseat, chesterfield, open_frame),
    test=(curved, sofa_bed),
)
