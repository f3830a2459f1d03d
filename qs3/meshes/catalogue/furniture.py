"""What chairs, tables and sofas share: legs, bent tubes, curved backs, upholstery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qs3.meshes.catalogue import parts as p
from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.mesh import Mesh


def both_sides(mesh: Mesh) -> list[Mesh]:
    """A part and its mirror image across the plane x = 0."""
    return [mesh, p.mirrored(mesh)]


def post(
    path: Sequence[p.Vector], section: np.ndarray, scale: Sequence[float] | None = None
) -> Mesh:
    """A leg whose cross-sections stay level, so that it stands flat on the floor.

    Args:
        path: centres of the sections from bottom to top.
        section: [N, 2] outline around its centre.
        scale: enlarges the section at each point of the path.
    """
    factors = [1.0] * len(path) if scale is None else scale
    rings = [
        p.ring_at(section * factor, 0.0) + np.asarray(point)
        for point, factor in zip(path, factors, strict=True)
    ]
    return p.loft(np.stack(rings))


def four_legs(
    width: float,
    depth: float,
    height: float,
    section: np.ndarray,
    *,
    splay: float = 0.0,
    foot: float = 1.0,
) -> list[Mesh]:
    """Straight legs at the corners of width x depth (between centres, at the upper end).

    Args:
        width: distance of the centres along x.
        depth: distance of the centres along y.
        height: length of the legs.
        section: [N, 2] outline at the upper end.
        splay: how far each foot stands out along x and along y.
        foot: scale of the section at the floor.
    """
    legs = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            top = np.array([sx * width / 2, sy * depth / 2, height])
            out = np.array([sx * splay, sy * splay, -height])
            legs.append(post([top + out, top], section, [foot, 1.0]))
    return legs


def leg_section(is_round: bool, size: float) -> np.ndarray:
    """Outline of a leg: round or square, `size` across."""
    return p.ellipse(size, size, 12) if is_round else p.rectangle(size, size)


def bent(points: Sequence[p.Vector], radius: float, steps: int = 5) -> np.ndarray:
    """[K, 3] a polyline with its inner corners rounded, as a bent tube's axis."""
    corners = np.asarray(points, dtype=np.float64)
    path = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        to_before, to_after = before - corner, after - corner
        lengths = np.linalg.norm(to_before), np.linalg.norm(to_after)
        cut = min(radius, 0.49 * float(min(lengths)))
        begin = corner + cut * to_before / lengths[0]
        end = corner + cut * to_after / lengths[1]
        path.append(p.arc(begin, corner, end, steps))
    return np.concatenate([*path, corners[-1:]])


def curved_panel(
    size: p.Vector, at: p.Vector, *, bow: float = 0.0, rake: float = 0.0, radius: float = 0.008
) -> Mesh:
    """An upright panel of (width, thickness, height), hollow towards -y by `bow` metres.

    `at` is the middle of its lower edge at the two ends; it leans back by `rake` degrees.
    """
    width, thickness, height = (float(s) for s in size)
    half = height / 2
    path = p.arc((-width / 2, 0, half), (0, 2 * bow, half), (width / 2, 0, half), 10)
    section = p.rounded_rectangle(thickness, height, radius, 2)
    return p.move(p.turn(p.sweep(section, path), -rake, "x"), at)


def back_cushion(
    size: p.Vector,
    at: p.Vector,
    *,
    rake: float = 10.0,
    crown: float = 0.03,
    radius: float = 0.04,
) -> Mesh:
    """A filled cushion of (width, thickness, height) leaning back, its crown to the front.

    `at` is the middle of the lower edge of its rear face.
    """
    width, thickness, height = (float(s) for s in size)
    lying = p.rounded_box((width, height, thickness), (0, 0, 0), radius, crown)
    upright = p.move(p.turn(lying, 90, "x"), (0, 0, height / 2))
    return p.move(p.turn(upright, -rake, "x"), at)


# Chairs ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChairSize:
    """The measures every chair has, in metres; `seat` and `top` are heights above the floor."""

    width: float
    depth: float
    seat: float
    top: float
    rake: float

    def back(self, z: float) -> float:
        """The y of the back's middle plane at height z (above the seat)."""
        return self.depth / 2 - 0.02 + (z - self.seat) * float(np.tan(np.radians(self.rake)))


def dining_size(draw: Draw) -> ChairSize:
    """Measures of an ordinary dining or kitchen chair."""
    seat = draw.between(0.42, 0.48)
    return ChairSize(
        width=draw.between(0.40, 0.50),
        depth=draw.between(0.40, 0.48),
        seat=seat,
        top=seat + draw.between(0.36, 0.56),
        rake=draw.between(4, 13),
    )


def rail_at(size: ChairSize, z: float, height: float, bow: float, thickness: float = 0.02) -> Mesh:
    """A horizontal board between the posts of the back, its lower edge at height z."""
    shape = (size.width - 0.05, thickness, height)
    return curved_panel(shape, (0, size.back(z), z), bow=bow, rake=size.rake)


# Tables --------------------------------------------------------------------------------


def plate(draw: Draw, width: float, depth: float, z: float, thick: float) -> Mesh:
    """A rectangular top whose upper face is at height z; its edge is sharp, round or bevelled."""
    at = (0, 0, z - thick)
    style = draw.pick("sharp", "corners", "round")
    if style == "sharp":
        return p.box((width, depth, thick), at)
    if style == "round":
        return p.rounded_box((width, depth, thick), at, 0.4 * thick)
    return p.slab(p.rounded_rectangle(width, depth, draw.between(0.03, 0.12), 5), thick, at)


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


def drawer(knob: str, size: tuple[float, float], at: p.Vector) -> list[Mesh]:
    """A drawer's front of (width, height) with its handle; `at` is the middle of its lower edge."""
    width, height = size
    x, y, z = (float(a) for a in at)
    middle = z + 0.55 * height
    out = [p.box((width, 0.018, height), (x, y - 0.009, z))]
    if knob == "knob":
        out.append(p.ellipsoid((0.03, 0.04, 0.03), (x, y - 0.03, middle), sides=10, rings=5))
    elif knob == "bar":
        half = min(0.08, 0.35 * width)
        ends = [(x - half, y - 0.01, middle), (x - half, y - 0.04, middle)]
        ends += [(x + half, y - 0.04, middle), (x + half, y - 0.01, middle)]
        out.append(p.tube(bent(ends, 0.01, 3), 0.006))
    return out


# Sofas ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class SofaSize:
    """The measures every sofa has, in metres; `seat`, `rest` and `top` are heights."""

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


def seat_cushions(size: SofaSize, thick: float, front: float, rear: float) -> list[Mesh]:
    """A row of seat cushions between the arms, from y = front to y = rear."""
    wide = size.inside / size.seats
    out = []
    for k in range(size.seats):
        at = ((k + 0.5) * wide - size.inside / 2, (front + rear) / 2, size.seat - thick)
        out.append(p.rounded_box((wide - 0.006, rear - front, thick), at, 0.04, 0.02))
    return out


def back_cushions(draw: Draw, size: SofaSize, thick: float, rear: float, rake: float) -> list[Mesh]:
    """A row of back cushions on the seat; `rear` is the y of their rear face at seat height."""
    wide, height = size.inside / size.seats, size.top - size.seat + draw.between(-0.03, 0.06)
    crown = draw.between(0.03, 0.06)
    out = []
    for k in range(size.seats):
        at = ((k + 0.5) * wide - size.inside / 2, rear, size.seat - 0.01)
        shape = (wide - 0.01, thick, height)
        out.append(back_cushion(shape, at, rake=rake, crown=crown, radius=0.055))
    return out


def scatter(draw: Draw, size: SofaSize, y: float) -> list[Mesh]:
    """None to three loose pillows that lean on the back, before the plane y."""
    out = []
    for _ in range(draw.count(0, 3)):
        side = draw.between(0.36, 0.48)
        lying = p.turn(p.pillow((side, side, 0.13), (0, 0, -0.065)), draw.between(-15, 15))
        x = draw.between(-0.5, 0.5) * (size.inside - side)
        upright = p.turn(lying, 90 - draw.between(12, 28), "x")
        out.append(p.move(upright, (x, y - 0.16, size.seat + 0.46 * side)))
    return out
