"""Cases of bays, declared as data: most cabinets and bookshelves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from qs3.catalogue import joinery as j
from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, Family
from qs3.meshes.mesh import Mesh

Range = tuple[float, float]
Row = tuple[str, float, Range]
"""What fills a share of a bay's height: its kind, the share, the height of one such front or
compartment in metres. Kinds: "drawer", "door", "open" (shelves), "glass" (shelves behind a door).
"""
WHOLE = (9.0, 9.0)  # one door over the whole share


@dataclass(frozen=True)
class Case:
    """Bays side by side, each filled from the bottom up. Lengths are ranges in metres.

    Attributes:
        bay: width of a bay.
        bays: how many, at least and at most.
        depth: of the case without its fronts.
        height: of the case without its feet.
        lift: height of the feet; below 3 cm there are none.
        layouts: a bay is one of these.
        alike: all bays are the same one.
        fronts: possible fronts, see `joinery.Look`.
        feet: possible feet, see `joinery.feet`.
        board: thickness of the boards.
        back: probability of a back.
        fill: how much of the open compartments holds something.
        top: a top plate lies on it, flush or overhanging.
    """

    bay: Range
    bays: tuple[int, int]
    depth: Range
    height: Range
    lift: Range
    layouts: tuple[tuple[Row, ...], ...]
    alike: bool = False
    fronts: tuple[str, ...] = ("flat", "flat", "framed", "raised")
    feet: tuple[str, ...] = ("plinth", "square", "tapered", "bun")
    board: Range = (0.018, 0.022)
    back: float = 1.0
    fill: Range = (0.3, 0.9)
    top: bool = True


def build(draw: Draw, case: Case, width: float = 0.0) -> list[Mesh]:
    """One piece on the floor, its middle at the origin; `width` overrules that of the bays."""
    bays = draw.count(*case.bays)
    depth, height = draw.between(*case.depth), draw.between(*case.height)
    width = width or bays * draw.between(*case.bay)
    each, board, look = width / bays, draw.between(*case.board), j.any_look(draw, *case.fronts)
    lift, fill = draw.between(*case.lift), draw.between(*case.fill)
    parts = []
    if lift > 0.03:
        parts += j.feet(draw, width, depth, lift, draw.pick(*case.feet))
    else:
        lift = 0.0
    parts += j.carcass((width, depth, height), (0, 0, lift), board, draw.chance(case.back))
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
                    parts += j.drawer(look, each, tall, depth, at, pulled)
            if kind in ("door", "glass"):
                hung = j.Look("glass", look.grip, look.scale) if kind == "glass" else look
                pair = 2 if each > 0.6 else 1
                for i in range(pair):
                    at = (x + each * ((i + 0.5) / pair - 0.5), -depth / 2, z)
                    angle = draw.between(20, 110) if draw.chance(0.15) else 0.0
                    hinge = 1 if (i if pair > 1 else k % 2) else -1
                    parts += j.door(hung, each / pair, share * height, at, hinge, angle)
            z += share * height
    if case.top:
        out, thick = draw.pick(0.0, draw.between(0.01, 0.03)), draw.between(0.015, 0.035)
        size = (width + 2 * out, depth + j.FRONT_M + out, thick)
        parts.append(p.box(size, (0, -(j.FRONT_M + out) / 2, lift + height)))
    return parts


def _compartment(
    draw: Draw, size: p.Vector, at: p.Vector, board: float, fill: float, *, shelf: bool
) -> list[Mesh]:
    """An open compartment of (width, depth, height) and what is in it; `at`: its front below."""
    width, depth, height = (float(s) for s in size)
    x, front, z = (float(c) for c in at)
    parts = [p.box((width - board, depth - 0.02, board), (x, front + depth / 2 + 0.01, z))]
    inner, room = width / 2 - board, (depth - 0.02, height - 2 * board)
    filling = j.contents(draw, x - inner, x + inner, front + 0.01, z + board, room, fill)
    return (parts if shelf else []) + filling


def stacked(lower: list[Mesh], upper: list[Mesh], gap: float = 0.0) -> list[Mesh]:
    """One piece on the other, or `gap` metres above it, their backs in one plane."""
    rear = [max(float(part.bounds[1, 1]) for part in piece) for piece in (lower, upper)]
    z = max(float(part.bounds[1, 2]) for part in lower) + gap
    return lower + [p.move(part, (0, rear[0] - rear[1], z)) for part in upper]


def families_of_cases(split: str, cases: dict[str, Case]) -> tuple[Family, ...]:
    """A family for each declared case."""
    return tuple(Family(name, split, partial(build, case=case)) for name, case in cases.items())
