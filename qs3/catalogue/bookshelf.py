"""Bookshelves: open cases, cube grids, low and half-closed ones, racks, ladders and corners."""

from dataclasses import replace

import numpy as np

from qs3.catalogue import parts as p
from qs3.catalogue.furniture import Draw, families_of
from qs3.catalogue.joinery import Case, build, contents, families_of_cases
from qs3.meshes.mesh import Mesh

TRAIN = {
    "open_shelves": Case(
        bay=(0.4, 0.9), bays=(1, 3), depth=(0.22, 0.36), height=(1.2, 2.2), lift=(0.0, 0.1),
        layouts=((("open", 1.0, (0.28, 0.42)),),), feet=("plinth", "plinth", "square"),
        board=(0.015, 0.03), back=0.6, fill=(0.0, 0.95), top=False,
    ),
    "cube_grid": Case(
        bay=(0.33, 0.4), bays=(1, 5), depth=(0.29, 0.4), height=(0.7, 1.9), lift=(0.0, 0.0),
        layouts=(
            (("open", 1.0, (0.33, 0.4)),), (("open", 1.0, (0.33, 0.4)),),
            (("drawer", 0.25, (0.16, 0.4)), ("open", 0.75, (0.33, 0.4))),
        ),
        board=(0.016, 0.04), back=0.4, fill=(0.2, 0.9), top=False,
    ),
    "lower_doors": Case(
        bay=(0.4, 0.75), bays=(1, 3), depth=(0.28, 0.42), height=(1.6, 2.2), lift=(0.04, 0.1),
        layouts=tuple(
            ((kind, low, (0.2, 0.4)), ("open", 1 - low, (0.27, 0.38)))
            for kind, low in (("door", 0.24), ("door", 0.38), ("drawer", 0.3))
        ),
        alike=True, feet=("plinth", "square", "bun"), board=(0.018, 0.028), fill=(0.3, 0.95),
    ),
}  # fmt: skip
TEST = {
    "low_wide": Case(
        bay=(0.4, 0.7), bays=(1, 4), depth=(0.2, 0.36), height=(0.3, 1.1), lift=(0.0, 0.16),
        layouts=((("open", 1.0, (0.24, 0.38)),),),
        board=(0.018, 0.03), back=0.7, fill=(0.4, 1.0),
    ),
}  # fmt: skip
WING = replace(TRAIN["open_shelves"], bays=(1, 1), lift=(0.0, 0.0))


def metal_rack(draw: Draw) -> list[Mesh]:
    """Shelves between four thin posts, some with a crossed brace behind."""
    width, depth = draw.between(0.6, 1.2), draw.between(0.3, 0.45)
    height, post, board = draw.between(1.1, 2.0), draw.between(0.018, 0.035), 0.022
    x, y, round_posts = (width - post) / 2, (depth - post) / 2, draw.chance(0.4)
    shape = p.cylinder(post / 2, height) if round_posts else p.box((post, post, height))
    parts = [p.move(shape, (sx * x, sy * y, 0)) for sx in (-1, 1) for sy in (-1, 1)]
    levels = np.linspace(draw.between(0.08, 0.2), height - board, draw.count(4, 6))
    fill, room = draw.pick(0.0, 0.6, 0.9), (depth - 0.02, float(levels[1] - levels[0]) - board)
    for z in levels.tolist():
        parts.append(p.box((width - 0.004, depth - 0.004, board), (0, 0, z)))
        parts += contents(draw, post - x, x - post, 0.01 - depth / 2, z + board, room, fill)
    if draw.chance(0.5):
        for s in (-1, 1):
            low, high = (-s * width / 2.1, y, levels[0]), (s * width / 2.1, y, levels[-1])
            parts.append(p.beam(low, high, (0.006, 0.02)))
    return parts


def ladder(draw: Draw) -> list[Mesh]:
    """A ladder shelf: two leaning rails, or two A-frames, with shelves deeper towards the floor."""
    width, height = draw.between(0.45, 0.8), draw.between(1.4, 2.0)
    depth, rail, shelves = draw.between(0.35, 0.55), draw.between(0.03, 0.06), draw.count(4, 5)
    lean, board, frames = draw.between(0.5, 0.8) * depth, 0.02, draw.chance(0.5)
    front, back, parts = -depth / 2, depth / 2, []
    slope = [(0, 0), (rail, 0), (rail + lean, height), (lean, height)]
    for s in (-1, 1):
        x = s * (width - 0.025) / 2
        parts.append(p.move(p.extrude(slope, 0.025, "x"), (x - 0.0125, front, 0)))
        if frames:
            parts.append(p.box((0.025, rail, height), (x, back - rail / 2, 0)))
    step = (height - 0.25) / (shelves - 1)
    for k in range(shelves):
        z = 0.12 + k * step
        start = front + lean * z / height
        deep, behind = back - start, start + lean * step / height
        parts.append(p.box((width - 0.05, deep, board), (0, start + deep / 2, z)))
        reach, room = width / 2 - 0.05, (back - behind, step - board)
        parts += contents(draw, -reach, reach, behind, z + board, room, 0.7)
    return parts


def corner(draw: Draw) -> list[Mesh]:
    """Shelves for the corner of a room: quarter rounds on a spine, or two wings of an L."""
    if draw.chance(0.5):
        long = draw.between(0.6, 1.0)
        wing = replace(WING, depth=(0.28, 0.28), height=(height := draw.between(1.1, 2.0),) * 2)
        side = [p.turn(part, -90) for part in build(draw, wing, long - 0.28)]
        shift = ((long - 0.28) / 2, -long / 2, 0)
        parts = build(draw, wing, long) + [p.move(part, shift) for part in side]
        return [p.turn(part, 45) for part in parts]  # the corner at the back, open to the front
    height, board, reach = draw.between(1.1, 2.0), draw.between(0.016, 0.03), draw.between(0.3, 0.5)
    angle = np.linspace(np.pi, 1.5 * np.pi, draw.pick(2, 3, 12))
    arc = reach * np.stack([np.cos(angle), np.sin(angle)], axis=1) * draw.pick(1.0, 1.15)
    outline, shelves = np.concatenate([[(0.0, 0.0)], arc]) + reach / 2, draw.count(4, 6)
    parts = [p.box((board, reach, height), (reach / 2, 0, 0))]
    parts.append(p.box((reach, board, height), (0, reach / 2, 0)))
    for z in np.linspace(0, height - board, shelves + 1).tolist():
        parts.append(p.slab(outline, board, (0, 0, z)))
        if z < height - board:
            room = (0.3 * reach, height / shelves - 2 * board)
            parts += contents(draw, 0.0, 0.4 * reach, 0.1 * reach, z + board, room, 0.6)
    return [p.turn(part, 45) for part in parts]


FAMILIES = (
    *families_of_cases("train", TRAIN),
    *families_of_cases("test", TEST),
    *families_of(train=(metal_rack,), test=(ladder, corner)),
)
