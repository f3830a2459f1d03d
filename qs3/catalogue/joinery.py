"""Cases of bays, declared as data, and their boards, fronts, feet and contents.

Most cabinets and bookshelves are made of them.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import CORNERS, Draw, Family
from qs3.meshes.mesh import Mesh

FRONT_M = 0.02  # thickness of doors and drawer fronts
GAP_M = 0.004  # between neighbouring fronts


Range = tuple[float, float]
Row = tuple[str, float, Range]
"""What fills a share of a bay's height: its kind, the share, the height of one such front or
compartment in metres. Kinds: "drawer", "door", "open" (shelves), "glass" (shelves behind a door).
"""
WHOLE = (9.0, 9.0)  # one door over the whole share


@dataclass(frozen=True)
class Look:
    """What all fronts of one piece have in common."""

    front: str  # "flat", "framed", "raised" or "glass"
    grip: str  # "knob", "bar" or "none"
    scale: float = 1.0  # of the grips


def any_look(draw: Draw, *fronts: str) -> Look:
    """A look with one of the given fronts (any but glass, if none is given)."""
    front = draw.pick(*(fronts or ("flat", "flat", "framed", "raised")))
    return Look(front, draw.pick("knob", "knob", "bar", "none"), draw.between(0.8, 1.3))


def carcass(
    size: p.Vector, at: p.Vector = p.ORIGIN, board: float = 0.02, back: bool = True
) -> list[Mesh]:
    """Sides, bottom, top and perhaps a back: an open case of (width, depth, height)."""
    width, depth, height = (float(s) for s in size)
    inner = width - 2 * board
    # the sides carry top and bottom
    parts = [p.box((board, depth, height), (s * (width - board) / 2, 0, 0)) for s in (-1, 1)]
    parts += [p.box((inner, depth, board), (0, 0, z)) for z in (0, height - board)]
    if back:
        parts.append(p.box((inner, 0.008, height), (0, depth / 2 - 0.004, 0)))
    return [p.move(part, at) for part in parts]


def frame(width: float, height: float, border: float, thickness: float, at: p.Vector) -> Mesh:
    """An upright picture frame; `at` is the middle of its lower back edge."""
    inner, outer = (p.rectangle(width - 2 * b, height - 2 * b) for b in (border, 0.0))
    rings = [
        np.column_stack([c[:, 0], np.full(4, y), c[:, 1] + height / 2])
        for c, y in [(outer, 0), (outer, -thickness), (inner, -thickness), (inner, 0)]
    ]
    return p.loft(np.stack(rings) + np.asarray(at, dtype=np.float64), loop=True)


def grip(look: Look, at: p.Vector, upright: bool = False, span: float = 0.13) -> list[Mesh]:
    """A handle on a front; `at` is the point of the front's face where it sits."""
    s, parts = look.scale, []
    if look.grip == "knob":
        parts.append(p.turn(p.cylinder(0.007 * s, 0.02 * s, sides=8), 90, "x"))
        size = (0.03 * s, 0.022 * s, 0.03 * s)
        parts.append(p.ellipsoid(size, (0, -0.025 * s, 0), sides=10, rings=5))
    elif look.grip == "bar":
        half = 0.5 * span * s
        parts.append(p.rod((-half, -0.03, 0), (half, -0.03, 0), 0.006 * s, sides=6))
        for x in (-0.8 * half, 0.8 * half):
            parts.append(p.rod((x, 0.002, 0), (x, -0.03, 0), 0.005 * s, sides=6))
        parts = [p.turn(part, 90 if upright else 0, "y") for part in parts]
    return [p.move(part, at) for part in parts]


def panel(look: Look, width: float, height: float, at: p.Vector) -> list[Mesh]:
    """A front without its handle; `at` is the middle of its lower back edge."""
    width, height = width - GAP_M, height - GAP_M
    x, y, z = (float(c) for c in at)
    z += GAP_M / 2
    border = min(0.06, 0.22 * min(width, height))
    if look.front in ("flat", "raised"):
        parts = [p.box((width, FRONT_M, height), (x, y - FRONT_M / 2, z))]
        if look.front == "raised":
            inset = (width - 2 * border, 0.03, height - 2 * border)
            parts.append(p.rounded_box(inset, (x, y - 0.018, z + border), radius=0.008, steps=1))
        return parts
    parts = [frame(width, height, border, FRONT_M + 0.005, (x, y, z))]
    if look.front == "framed":
        parts.append(p.box((width - 0.01, 0.01, height - 0.01), (x, y - 0.006, z + 0.005)))
    else:  # glass, which a depth sensor looks through: only its bars are there
        bars = 1 + int(height / 0.45)
        for k in range(1, bars):
            bar = (width - border, 0.012, 0.02)
            parts.append(p.box(bar, (x, y - 0.012, z + height * k / bars)))
    return parts


def door(
    look: Look, width: float, height: float, at: p.Vector, hinge: int = -1, angle: float = 0.0
) -> list[Mesh]:
    """A door before a case whose front is at `at` (lower middle), hung left (-1) or right (1).

    `angle` opens it by degrees.
    """
    x, y, z = (float(c) for c in at)
    spot = (x - hinge * (width / 2 - 0.035), y - FRONT_M, z + 0.5 * height)
    parts = panel(look, width, height, at) + grip(look, spot, upright=True)
    return [p.turn(part, hinge * angle, "z", (x + hinge * width / 2, y, z)) for part in parts]


def drawer(
    look: Look, width: float, height: float, depth: float, at: p.Vector, pulled: float = 0.0
) -> list[Mesh]:
    """A drawer whose closed front stands before `at`; its box is made when it is pulled out."""
    x, y, z = (float(c) for c in at)
    parts = panel(look, width, height, at)
    grips = 2 if width > 0.55 else 1
    for k in range(grips):
        spot = (x + width * ((k + 0.5) / grips - 0.5), y - FRONT_M, z + 0.55 * height)
        parts += grip(look, spot, span=min(0.13, 0.5 * width))
    if pulled > 0:
        w, h, middle = width - 0.03, 0.75 * height, y + depth / 2 - 0.015
        parts.append(p.box((w, depth - 0.03, 0.01), (x, middle, z + 0.02)))
        sides = (x - (w / 2 - 0.006), x + (w / 2 - 0.006))
        parts += [p.box((0.012, depth - 0.03, h), (side, middle, z + 0.02)) for side in sides]
        parts.append(p.box((w, 0.012, h), (x, y + depth - 0.036, z + 0.02)))
    return [p.move(part, (0, -pulled, 0)) for part in parts]


def feet(draw: Draw, width: float, depth: float, height: float, kind: str) -> list[Mesh]:
    """Something to stand on, from the floor up to `height`, under a case at the origin.

    `kind` is "plinth", "square", "tapered" or "bun".
    """
    if kind == "plinth":
        return [p.box((width - 0.01, depth - 0.06, height), (0, 0.03, 0))]
    inset, thick = draw.between(0.03, 0.09), draw.between(0.03, 0.05)
    splay = draw.between(0.0, 0.35) * height
    bulge = [(0.5, 0), (0.9, 0.3), (1, 0.55), (0.75, 0.9), (0.6, 1)]
    parts = []
    for sx, sy in CORNERS:
        x, y = sx * (width / 2 - inset), sy * (depth / 2 - inset)
        if kind == "square":
            parts.append(p.box((thick, thick, height), (x, y, 0)))
        elif kind == "bun":
            profile = [(1.1 * thick * r, height * t) for r, t in bulge]
            parts.append(p.lathe(profile, (x, y, 0), sides=12))
        else:
            foot, top, dx, dy = (0.5 * thick,) * 2, (thick,) * 2, splay * sx, 0.5 * splay * sy
            parts.append(p.frustum(foot, top, height, (x + dx, y + dy, 0), (-dx, -dy)))
    return parts


def books(
    draw: Draw, left: float, right: float, front: float, z: float, room: p.Vector
) -> list[Mesh]:
    """A row of standing books from `left` on; room is the (depth, height) of the compartment."""
    depth, height = (float(r) for r in room)
    tall, thick = min(0.95 * height, draw.between(0.2, 0.34)), draw.between(0.02, 0.045)
    parts, x = [], left + 0.002
    while x < right - 0.06:
        t = thick * draw.between(0.5, 1.5)
        size = (t, min(depth - 0.01, draw.between(0.13, 0.22)), tall * draw.between(0.72, 1.0))
        start = front + draw.between(0.005, 0.02)
        parts.append(p.box(size, (x + t / 2, start + size[1] / 2, z)))
        x += t + 0.001
    return parts


def contents(
    draw: Draw, left: float, right: float, front: float, z: float, room: p.Vector, fill: float
) -> list[Mesh]:
    """What stands in one compartment: books mostly, some things, or nothing (1 - fill)."""
    if not draw.chance(fill):
        return []
    depth, height = (float(r) for r in room)
    width = right - left
    kind = draw.pick("books", "books", "books", "row", "pile", "vase", "box")
    middle = (draw.between(left + 0.35 * width, right - 0.35 * width), front + 0.5 * depth, z)
    if kind == "books":
        return books(draw, left, right, front, z, room)
    if kind == "row":
        return books(draw, left, left + draw.between(0.4, 0.8) * width, front, z, room)
    if kind == "pile":
        parts, level = [], 0.0
        for _ in range(draw.count(2, 6)):
            wide, deep = draw.between(0.17, 0.28), draw.between(0.14, 0.2)
            size = (min(wide, 0.6 * width), min(deep, 0.9 * depth), draw.between(0.015, 0.04))
            if level + size[2] > height:
                break
            lying = p.turn(p.box(size), draw.between(-6, 6))
            parts.append(p.move(lying, (middle[0], middle[1], z + level)))
            level += size[2]
        return parts
    if kind == "vase":
        r = min(0.3 * depth, 0.25 * width, 0.09)
        tall = min(0.85 * height, draw.between(0.12, 0.32))
        shape = [(0.6, 0), (1.0, 0.35), (0.9, 0.6), (0.35, 0.85), (0.5, 1), (0.4, 1), (0.25, 0.85)]
        return [p.lathe([(s * r, t * tall) for s, t in shape], middle, sides=14)]
    wide = min(draw.between(0.4, 0.85) * width, 0.4)
    size = (wide, 0.8 * depth, min(draw.between(0.3, 0.75) * height, 0.25))
    return [p.box(size, (left + 0.5 * width, middle[1], z))]


@dataclass(frozen=True)
class Case:
    """Bays side by side, each filled from the bottom up. Lengths are ranges in metres."""

    bay: Range  # width of a bay
    bays: tuple[int, int]  # how many, at least and at most
    depth: Range  # of the case without its fronts
    height: Range  # of the case without its feet
    lift: Range  # height of the feet; below 3 cm there are none
    layouts: tuple[tuple[Row, ...], ...]  # a bay is one of these
    alike: bool = False  # all bays are the same one
    fronts: tuple[str, ...] = ("flat", "flat", "framed", "raised")  # see `Look`
    feet: tuple[str, ...] = ("plinth", "square", "tapered", "bun")  # see `feet`
    board: Range = (0.018, 0.022)  # thickness of the boards
    back: float = 1.0  # probability of a back
    fill: Range = (0.3, 0.9)  # how much of the open compartments holds something
    top: bool = True  # a top plate lies on it, flush or overhanging


def build(draw: Draw, case: Case, width: float = 0.0) -> list[Mesh]:
    """One piece on the floor, its middle at the origin; `width` overrules that of the bays."""
    bays = draw.count(*case.bays)
    depth, height = draw.between(*case.depth), draw.between(*case.height)
    width = width or bays * draw.between(*case.bay)
    each, board, look = width / bays, draw.between(*case.board), any_look(draw, *case.fronts)
    lift, fill = draw.between(*case.lift), draw.between(*case.fill)
    parts = []
    if lift > 0.03:
        parts += feet(draw, width, depth, lift, draw.pick(*case.feet))
    else:
        lift = 0.0
    parts += carcass((width, depth, height), (0, 0, lift), board, draw.chance(case.back))
    layout = draw.pick(*case.layouts)
    for k in range(bays):
        x = each * (k + 0.5) - width / 2
        if k:
            parts.append(p.box((board, depth - 0.01, height - 0.01), (x - each / 2, 0.005, lift)))
            layout = layout if case.alike else draw.pick(*case.layouts)
        z = lift
        for kind, share, one in layout:
            count = max(1, round(share * height / draw.between(*one)))
            tall = share * height / count
            if z > lift:
                parts.append(p.box((each, depth - 0.01, board), (x, 0.005, z)))
            for row in range(count):
                at, size = (x, -depth / 2, z + row * tall), (each, depth, tall)
                if kind in ("open", "glass"):
                    parts += _compartment(draw, size, at, board, fill, shelf=row > 0)
                elif kind == "drawer":
                    pulled = draw.between(0.1, 0.6) * depth if draw.chance(0.12) else 0.0
                    parts += drawer(look, each, tall, depth, at, pulled)
            if kind in ("door", "glass"):
                hung = Look("glass", look.grip, look.scale) if kind == "glass" else look
                pair = 2 if each > 0.6 else 1
                for i in range(pair):
                    at = (x + each * ((i + 0.5) / pair - 0.5), -depth / 2, z)
                    angle = draw.between(20, 110) if draw.chance(0.15) else 0.0
                    hinge = 1 if (i if pair > 1 else k % 2) else -1
                    parts += door(hung, each / pair, share * height, at, hinge, angle)
            z += share * height
    if case.top:
        out, thick = draw.pick(0.0, draw.between(0.01, 0.03)), draw.between(0.015, 0.035)
        size = (width + 2 * out, depth + FRONT_M + out, thick)
        parts.append(p.box(size, (0, -(FRONT_M + out) / 2, lift + height)))
    return parts


def _compartment(
    draw: Draw, size: p.Vector, at: p.Vector, board: float, fill: float, *, shelf: bool
) -> list[Mesh]:
    """An open compartment of (width, depth, height) and what is in it; `at`: its front below."""
    width, depth, height = (float(s) for s in size)
    x, front, z = (float(c) for c in at)
    parts = [p.box((width - board, depth - 0.02, board), (x, front + depth / 2 + 0.01, z))]
    inner, room = width / 2 - board, (depth - 0.02, height - 2 * board)
    filling = contents(draw, x - inner, x + inner, front + 0.01, z + board, room, fill)
    return (parts if shelf else []) + filling


def stacked(lower: list[Mesh], upper: list[Mesh], gap: float = 0.0) -> list[Mesh]:
    """One piece on the other, or `gap` metres above it, their backs in one plane."""
    rear = [max(float(part.bounds[1, 1]) for part in piece) for piece in (lower, upper)]
    z = max(float(part.bounds[1, 2]) for part in lower) + gap
    return lower + [p.move(part, (0, rear[0] - rear[1], z)) for part in upper]


def families_of_cases(split: str, cases: dict[str, Case]) -> tuple[Family, ...]:
    """A family for each declared case."""
    return tuple(Family(name, split, partial(build, case=case)) for name, case in cases.items())
