"""Bookshelves: open cases, cube grids, racks, ladders, corners, steps; with and without books."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.joinery import any_look, carcass, contents, door, drawer, feet
from qs3.meshes.catalogue.parts import beam, box, extrude, frustum, move, rod, slab, turn
from qs3.meshes.mesh import Mesh


def _levels(draw: Draw, low: float, high: float, count: int) -> list[float]:
    """Heights of `count` shelves from low on, unevenly spaced half of the time."""
    spread = 0.18 if draw.chance(0.5) else 0.0
    steps = np.array([1 + draw.between(-spread, spread) for _ in range(count)])
    return [
        float(z)
        for z in low + (high - low) * np.concatenate([[0], np.cumsum(steps)[:-1]]) / steps.sum()
    ]


def _filled(
    draw: Draw,
    levels: list[float],
    top: float,
    bay: tuple[float, float],
    front: float,
    depth: float,
    board: float,
    fill: float,
) -> list[Mesh]:
    """What stands on the shelves at `levels` between the x of a bay, under a `top`."""
    parts = []
    for z, above in zip(levels, [*levels[1:], top], strict=True):
        room = (depth, above - z - board)
        parts += contents(draw, bay[0], bay[1], front, z + board, room, fill)
    return parts


def open_shelves(draw: Draw) -> list[Mesh]:
    """The plain tall bookcase: sides, shelves, one to three bays, with a back or without."""
    bays, board = draw.pick(1, 1, 1, 2, 3), draw.between(0.015, 0.03)
    each, depth = draw.between(0.4, 0.9) * (1 if bays < 3 else 0.75), draw.between(0.22, 0.36)
    width, height, lift = bays * each, draw.between(1.2, 2.2), draw.between(0.0, 0.1)
    fill, shelves = draw.pick(0.0, 0.5, 0.8, 0.95), max(3, round(height / draw.between(0.28, 0.42)))
    back = draw.chance(0.6)
    parts = feet(draw, width, depth, lift, "plinth", "plinth", "square") if lift > 0.03 else []
    lift = lift if parts else 0.0
    parts += carcass((width, depth, height), (0, 0, lift), board, back)
    for k in range(bays):
        x = each * (k + 0.5) - width / 2
        if k:
            parts.append(box((board, depth, height), (x - each / 2, 0, lift)))
        levels = _levels(draw, lift, lift + height - board, shelves)
        for z in levels[1:]:
            parts.append(box((each - board, depth - 0.01, board), (x, 0.005, z)))
        bay, top = (x - each / 2 + board, x + each / 2 - board), lift + height - board
        parts += _filled(draw, levels, top, bay, -depth / 2, depth, board, fill)
    if draw.chance(0.25):
        size = (width + 0.08, depth + 0.05)
        parts.append(frustum((width, depth), size, 0.07, (0, 0, lift + height)))
    return parts


def cube_grid(draw: Draw) -> list[Mesh]:
    """A grid of square compartments, some with baskets, doors or drawers."""
    columns, rows = draw.pick(
        (1, 4), (2, 2), (2, 3), (2, 4), (3, 3), (3, 4), (4, 4), (5, 5), (4, 2)
    )
    cell, board, depth = draw.between(0.33, 0.4), draw.between(0.016, 0.04), draw.between(0.29, 0.4)
    width, height = columns * cell + board, rows * cell + board
    back, fill, closed = draw.chance(0.4), draw.between(0.2, 0.9), draw.pick(0.0, 0.0, 0.15)
    look = any_look(draw, "flat", "framed")
    parts = carcass((width, depth, height), board=board, back=back)
    for k in range(1, columns):
        parts.append(box((board, depth, height), (k * cell - width / 2 + board / 2, 0, 0)))
    for k in range(1, rows):
        parts.append(box((width - board, depth, board), (0, 0, k * cell)))
    for column in range(columns):
        x = (column + 0.5) * cell - width / 2 + board / 2
        bay = (x - cell / 2 + board / 2, x + cell / 2 - board / 2)
        for row in range(rows):
            z = row * cell + board
            if draw.chance(closed):
                at, inner = (x, -depth / 2 + 0.02, z), cell - board
                if draw.chance(0.5):
                    parts += door(look, inner, inner, at)
                else:
                    for r in range(2):
                        spot = (x, at[1], z + r * inner / 2)
                        parts += drawer(look, inner, inner / 2, depth, spot)
            else:
                room = (depth, cell - board)
                parts += contents(draw, *bay, -depth / 2, z, room, fill)
    return parts


def lower_doors(draw: Draw) -> list[Mesh]:
    """Open shelves above, doors or drawers in the lower part: half a cabinet."""
    bays, depth = draw.count(1, 3), draw.between(0.28, 0.42)
    each, height, lift = draw.between(0.4, 0.75), draw.between(1.6, 2.2), draw.between(0.04, 0.1)
    width, board, low = bays * each, draw.between(0.018, 0.028), height * draw.between(0.22, 0.42)
    look, fill, front = any_look(draw), draw.between(0.3, 0.95), -depth / 2
    parts = feet(draw, width, depth, lift, "plinth", "square", "bun")
    parts += carcass((width, depth, height), (0, 0, lift), board)
    parts.append(box((width, depth + 0.03, board), (0, -0.015, lift + low)))
    count = max(3, round((height - low) / draw.between(0.27, 0.38)))
    style = draw.pick("doors", "doors", "drawers")
    for k in range(bays):
        x = each * (k + 0.5) - width / 2
        if k:
            parts.append(box((board, depth, height - 0.01), (x - each / 2, 0, lift)))
        if style == "doors":
            pair = 2 if each > 0.6 else 1
            for j in range(pair):
                at = (x + each * ((j + 0.5) / pair - 0.5), front, lift)
                angle = draw.between(25, 100) if draw.chance(0.1) else 0.0
                hinge = 1 if j or (pair == 1 and k % 2) else -1
                parts += door(look, each / pair, low, at, hinge=hinge, angle=angle, grip_at=0.75)
        else:
            for r in range(2):
                parts += drawer(look, each, low / 2, depth, (x, front, lift + r * low / 2))
        levels = _levels(draw, lift + low, lift + height - board, count)
        for z in levels[1:]:
            parts.append(box((each - board, depth - 0.02, board), (x, 0.01, z)))
        bay, top = (x - each / 2 + board, x + each / 2 - board), lift + height - board
        parts += _filled(draw, levels, top, bay, front, depth, board, fill)
    return parts


def metal_rack(draw: Draw) -> list[Mesh]:
    """Shelves between four thin posts, of boards or wires, with side rungs or a back brace."""
    width, depth = draw.between(0.6, 1.2), draw.between(0.3, 0.45)
    height, post, board = draw.between(1.1, 2.0), draw.between(0.018, 0.035), 0.022
    corners = [
        (sx * (width - post) / 2, sy * (depth - post) / 2) for sx in (-1, 1) for sy in (-1, 1)
    ]
    round_posts, wires = draw.chance(0.4), draw.chance(0.35)
    parts = []
    for x, y in corners:
        if round_posts:
            parts.append(rod((x, y, 0), (x, y, height), post / 2))
        else:
            parts.append(box((post, post, height), (x, y, 0)))
    shelves = draw.count(4, 6)
    levels = _levels(draw, draw.between(0.08, 0.2), height + 0.02, shelves)
    levels[-1] = height - board if draw.chance(0.5) else levels[-1]
    for z in levels:
        if not wires:
            parts.append(box((width - 0.004, depth - 0.004, board), (0, 0, z)))
            continue
        for s in (-1, 1):
            y = s * (depth - post) / 2
            parts.append(box((width - post, 0.012, board), (0, y, z)))
            parts.append(box((0.012, depth - post, board), (s * (width - post) / 2, 0, z)))
        count = int(width / 0.035)
        for k in range(1, count):
            x = width * (k / count - 0.5)
            parts.append(box((0.009, depth - 0.02, 0.009), (x, 0, z + board - 0.009)))
    y = (depth - post) / 2
    if draw.chance(0.5):
        for s in (-1, 1):
            low, high = (-s * width / 2.1, y, levels[0]), (s * width / 2.1, y, levels[-1])
            parts.append(beam(low, high, (0.006, 0.02)))
    bay = (-width / 2 + post, width / 2 - post)
    fill = draw.pick(0.0, 0.6, 0.9)
    return parts + _filled(draw, levels, levels[-1] + 0.35, bay, -depth / 2, depth, board, fill)


def low_wide(draw: Draw) -> list[Mesh]:
    """A long bookcase of one to three rows, such as stands under a window."""
    bays, rows, board = draw.count(2, 4), draw.count(1, 3), draw.between(0.018, 0.03)
    each, row, depth = draw.between(0.4, 0.7), draw.between(0.28, 0.38), draw.between(0.26, 0.38)
    width, height, lift = bays * each, rows * row + board, draw.between(0.04, 0.16)
    parts = feet(draw, width, depth, lift)
    parts += carcass((width, depth, height), (0, 0, lift), board, draw.chance(0.7))
    parts.append(box((width + 0.02, depth + 0.02, board), (0, 0, lift + height)))
    fill = draw.between(0.4, 1.0)
    for k in range(bays):
        x = each * (k + 0.5) - width / 2
        if k:
            parts.append(box((board, depth, height), (x - each / 2, 0, lift)))
        levels = [lift + r * row for r in range(rows)]
        for z in levels[1:]:
            parts.append(box((each - board, depth - 0.01, board), (x, 0.005, z)))
        bay = (x - each / 2 + board, x + each / 2 - board)
        parts += _filled(draw, levels, lift + rows * row, bay, -depth / 2, depth, board, fill)
    top = lift + height + board
    return parts + contents(draw, -0.45 * width, 0.45 * width, -depth / 2, top, (depth, 0.3), 0.4)


def stepped(draw: Draw) -> list[Mesh]:
    """A staircase of compartments, each column one lower than its neighbour."""
    columns, board = draw.count(3, 5), draw.between(0.018, 0.035)
    cell, depth, fill = draw.between(0.3, 0.4), draw.between(0.26, 0.38), draw.between(0.2, 0.9)
    width, rise, back = columns * cell, draw.between(0.9, 1.15) * cell, draw.chance(0.4)
    left = draw.chance(0.5)
    parts = []
    for k in range(columns):
        tall = (columns - k) if left else (k + 1)
        x = (k + 0.5) * cell - width / 2
        parts += carcass((cell + board, depth, tall * rise + board), (x, 0, 0), board, back)
        levels = [r * rise for r in range(tall)]
        for z in levels[1:]:
            parts.append(box((cell, depth, board), (x, 0, z)))
        bay = (x - (cell - board) / 2, x + (cell - board) / 2)
        parts += _filled(draw, levels, tall * rise, bay, -depth / 2, depth, board, fill)
    return parts


def ladder(draw: Draw) -> list[Mesh]:
    """A ladder shelf: two leaning rails, or two A-frames, with shelves deeper towards the floor."""
    width, height = draw.between(0.45, 0.8), draw.between(1.4, 2.0)
    depth, rail, shelves = draw.between(0.35, 0.55), draw.between(0.03, 0.06), draw.count(4, 5)
    lean, board, frames = draw.between(0.5, 0.8) * depth, 0.02, draw.chance(0.5)
    front, back = -depth / 2, depth / 2
    parts = []
    for s in (-1, 1):
        x = s * (width - 0.025) / 2 - 0.0125
        slope = [
            (front, 0),
            (front + rail, 0),
            (front + rail + lean, height),
            (front + lean, height),
        ]
        parts.append(move(extrude(slope, 0.025, "x"), (x, 0, 0)))
        if frames:
            parts.append(box((0.025, rail, height), (x + 0.0125, back - rail / 2, 0)))
    levels = [0.12 + k * (height - 0.25) / (shelves - 1) for k in range(shelves)]
    for z, above in zip(levels, [*levels[1:], levels[-1] + 0.3], strict=True):
        start = front + lean * z / height
        deep = back - start
        parts.append(box((width - 0.05, deep, board), (0, start + deep / 2, z)))
        if not frames:  # raised edges
            parts.append(box((width - 0.05, 0.012, 0.06), (0, back - 0.006, z)))
            for s in (-1, 1):
                at = (s * (width - 0.062) / 2, start + deep / 2, z)
                parts.append(box((0.012, deep, 0.06), at))
        room = (deep, above - z - board)
        reach = width / 2 - 0.05
        shift = start + max(0.0, lean * (above - z) / height - 0.02)
        parts += contents(draw, -reach, reach, shift, z + board, (back - shift, room[1]), 0.7)
    return parts


def corner(draw: Draw) -> list[Mesh]:
    """Shelves for the corner of a room: quarter rounds on a spine, or two wings of an L."""
    height, shelves, board = draw.between(1.1, 2.0), draw.count(4, 6), draw.between(0.016, 0.03)
    reach = draw.between(0.3, 0.5)
    levels = _levels(draw, 0.0, height - board, shelves)
    if draw.chance(0.5):
        angle = np.linspace(np.pi, 1.5 * np.pi, draw.pick(2, 3, 12))
        arc = reach * np.stack([np.cos(angle), np.sin(angle)], axis=1) * draw.pick(1.0, 1.15)
        outline = np.concatenate([[(0.0, 0.0)], arc]) + reach / 2
        parts = [slab(outline, board, (0, 0, z)) for z in [*levels, height - board]]
        parts.append(box((board, reach, height), (reach / 2, 0, 0)))
        parts.append(box((reach, board, height), (0, reach / 2, 0)))
        for z in levels:
            if draw.chance(0.6):
                middle = (-0.05 * reach, 0.3 * reach)
                room = (0.3 * reach, height / shelves - 2 * board)
                parts += contents(draw, *middle, 0.1 * reach, z + board, room, 1.0)
        return [turn(p, 45) for p in parts]
    depth, long, fill = draw.between(0.24, 0.32), draw.between(0.6, 1.0), draw.between(0.3, 0.9)
    wing, offset = carcass((long, depth, height), board=board), (long - depth) / 2
    side = carcass((long - depth, depth, height), board=board)
    span = (board - long / 2, long / 2 - board)
    for z in levels:
        wing.append(box((long - board, depth - 0.01, board), (0, 0.005, z)))
        side.append(box((long - depth - board, depth - 0.01, board), (0, 0.005, z)))
    wing += _filled(
        draw, levels, height, (span[0], span[1] - depth), -depth / 2, depth, board, fill
    )
    inner = (span[0] + depth / 2, span[1] - depth / 2)
    side += _filled(draw, levels, height, inner, -depth / 2, depth, board, fill)
    # the second wing faces -x and runs forward from the right end of the first
    turned = [Mesh(p.vertices[:, [1, 0, 2]] * (1, -1, 1), p.faces) for p in side]
    parts = wing + [move(p, (offset, -long / 2, 0)) for p in turned]
    return [turn(p, 45) for p in parts]  # the corner at the back, open to the front


def wall_piece(draw: Draw) -> list[Mesh]:
    """A small shelf meant for a wall, standing on the floor: a box frame, or boards on a ladder."""
    width, depth = draw.between(0.5, 1.2), draw.between(0.16, 0.26)
    board, rows = draw.between(0.015, 0.03), draw.count(1, 3)
    row, fill = draw.between(0.2, 0.34), draw.pick(0.3, 0.9)
    height = rows * row + board
    reach = width / 2
    levels = [k * row for k in range(rows)]
    if draw.chance(0.5):
        parts = carcass((width, depth, height), board=board, back=draw.chance(0.5))
    else:  # side strips with boards that overhang them
        inset = draw.between(0.05, 0.15) * width
        reach -= inset
        parts = [box((board, depth, height + 0.1), (s * reach, 0, 0)) for s in (-1, 1)]
        parts.append(box((width, depth, board), (0, 0, rows * row)))
        parts += [box((2 * reach, depth, board), (0, 0, 0))]
    for z in levels[1:]:
        parts.append(box((2 * reach - board, depth - 0.005, board), (0, 0.0025, z)))
    if draw.chance(0.4):
        parts.append(
            box((board, depth - 0.01, height), (draw.between(-0.5, 0.5) * reach, 0.005, 0))
        )
    bay = (board - reach, reach - board)
    return parts + _filled(draw, levels, rows * row, bay, -depth / 2, depth, board, fill)


FAMILIES: tuple[Family, ...] = (
    train(open_shelves),
    train(cube_grid),
    train(lower_doors),
    train(metal_rack),
    train(low_wide),
    train(stepped),
    test(ladder),
    test(corner),
    test(wall_piece),
)
