"""Cabinets: night stands, chests, wardrobes, sideboards, kitchen, filing, glass doors, hutches."""

from __future__ import annotations

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.joinery import (
    FRONT_M,
    Look,
    any_look,
    carcass,
    contents,
    door,
    drawer,
    feet,
    frame,
    grip,
)
from qs3.meshes.catalogue.parts import box, ellipsoid, extrude, frustum, move, rod, rounded_box
from qs3.meshes.mesh import Mesh

BOARD = 0.02


def _top(draw: Draw, width: float, depth: float, z: float) -> list[Mesh]:
    """A top plate, overhanging or flush, round-edged or sharp."""
    out, thick = draw.pick(0.0, draw.between(0.01, 0.03)), draw.between(0.015, 0.035)
    size, at = (width + 2 * out, depth + FRONT_M + out, thick), (0, -(FRONT_M + out) / 2, z)
    return [rounded_box(size, at, radius=0.012, steps=2) if draw.chance(0.3) else box(size, at)]


def _pull(draw: Draw, depth: float, odds: float = 0.12) -> float:
    """How far a drawer stands open, mostly not at all."""
    return draw.between(0.1, 0.6) * depth if draw.chance(odds) else 0.0


def _swing(draw: Draw, odds: float = 0.2) -> float:
    """How far a door stands open in degrees, mostly not at all."""
    return draw.between(20, 110) if draw.chance(odds) else 0.0


def _doors(
    draw: Draw,
    look: Look,
    width: float,
    height: float,
    front: float,
    z: float,
    count: int,
    *,
    odds: float = 0.2,
    grip_at: float = 0.5,
) -> list[Mesh]:
    """`count` doors side by side before a case, hung in pairs."""
    parts = []
    each = width / count
    for k in range(count):
        hinge = -1 if k % 2 == 0 else 1
        at = (each * (k + 0.5) - width / 2, front, z)
        angle = _swing(draw, odds)
        parts += door(look, each, height, at, hinge=hinge, angle=angle, grip_at=grip_at)
    return parts


def night_stand(draw: Draw) -> list[Mesh]:
    """A bedside cabinet: one to three drawers, or a drawer over an open shelf or a door."""
    width, depth = draw.between(0.36, 0.6), draw.between(0.32, 0.46)
    lift, height = draw.between(0.04, 0.25), draw.between(0.3, 0.48)
    look = any_look(draw)
    parts = feet(draw, width, depth, lift) + carcass((width, depth, height), (0, 0, lift))
    front, top = -depth / 2, lift + height
    kind = draw.pick("drawers", "drawers", "shelf", "door")
    if kind == "drawers":
        rows = draw.count(1, 3)
        for k in range(rows):
            at = (0, front, lift + k * height / rows)
            parts += drawer(look, width, height / rows, depth, at, pulled=_pull(draw, depth, 0.15))
    else:
        part = height * draw.between(0.3, 0.42)
        at = (0, front, top - part)
        parts += drawer(look, width, part, depth, at, pulled=_pull(draw, depth, 0.15))
        parts.append(box((width - BOARD, depth - 0.01, BOARD), (0, 0.005, top - part)))
        if kind == "door":
            parts += _doors(draw, look, width, height - part, front, lift, 1)
        else:
            room = (depth, height - part - 2 * BOARD)
            parts += contents(
                draw, -width / 2 + BOARD, width / 2 - BOARD, front, lift + BOARD, room
            )
    return parts + _top(draw, width, depth, top)


def chest_of_drawers(draw: Draw) -> list[Mesh]:
    """A dresser of three to six rows of drawers, sometimes two columns or halved at the top."""
    width, depth = draw.between(0.6, 1.5), draw.between(0.38, 0.55)
    lift, height = draw.between(0.03, 0.18), draw.between(0.6, 1.15)
    look, rows = any_look(draw, "flat", "flat", "raised", "framed"), draw.count(3, 6)
    columns, halved = 2 if width > 1.15 else 1, draw.chance(0.4)
    parts = feet(draw, width, depth, lift) + carcass((width, depth, height), (0, 0, lift))
    for row in range(rows):
        count = 2 if halved and row == rows - 1 else columns
        each = width / count
        for k in range(count):
            at = (each * (k + 0.5) - width / 2, -depth / 2, lift + row * height / rows)
            grips = 2 if each > 0.55 and look.grip != "none" else 1
            pulled = _pull(draw, depth)
            parts += drawer(look, each, height / rows, depth, at, pulled=pulled, grips=grips)
    if draw.chance(0.15):
        tall = draw.between(0.5, 0.8)  # a dressing mirror
        at = (0, depth / 2 - 0.02, lift + height)
        parts += [frame(0.6 * width, tall, 0.05, 0.03, at), box((0.58 * width, 0.01, tall), at)]
    return parts + _top(draw, width, depth, lift + height)


def wardrobe(draw: Draw) -> list[Mesh]:
    """A tall cabinet of one to four doors, sometimes drawers below, a cornice, an open door."""
    count = draw.count(1, 4)
    width, depth = count * draw.between(0.42, 0.56), draw.between(0.5, 0.65)
    lift, height = draw.between(0.04, 0.14), draw.between(1.7, 2.2)
    look = any_look(draw)
    front = -depth / 2
    parts = feet(draw, width, depth, lift, "plinth", "plinth", "square", "bun")
    parts += carcass((width, depth, height), (0, 0, lift))
    low = height * draw.between(0.15, 0.28) if draw.chance(0.35) else 0.0
    if low:
        each = width / max(1, count // 2)
        for k in range(max(1, count // 2)):
            at = (each * (k + 0.5) - width / 2, front, lift)
            grips = 2 if each > 0.6 else 1
            parts += drawer(look, each, low, depth, at, pulled=_pull(draw, depth), grips=grips)
    parts.append(box((width - 0.03, depth - 0.02, BOARD), (0, 0.01, lift + max(low, BOARD))))
    parts.append(box((width - 0.03, depth - 0.02, BOARD), (0, 0.01, lift + 0.84 * height)))
    rail = lift + 0.8 * height
    parts.append(rod((0.01 - width / 2, 0, rail), (width / 2 - 0.01, 0, rail), 0.012))
    parts += _doors(draw, look, width, height - low, front, lift + low, count, odds=0.25)
    for _ in range(draw.count(0, 8)):  # clothes on hangers
        x, drop = draw.between(0.06 - width / 2, width / 2 - 0.06), draw.between(0.5, 0.95)
        at = (x, 0, rail - drop)
        parts.append(frustum((0.05, 0.44), (0.03, 0.3), min(drop, 0.6 * height), at))
    if draw.chance(0.3):
        out = draw.between(0.02, 0.06)
        size = (width + 2 * out, depth + FRONT_M + out)
        at = (0, -(FRONT_M + out) / 2, lift + height)
        parts.append(frustum((width, depth + FRONT_M), size, draw.between(0.04, 0.1), at))
    return parts


def sideboard(draw: Draw) -> list[Mesh]:
    """A long low cabinet on legs: doors at the sides, drawers or an open bay between."""
    width, depth = draw.between(1.1, 2.0), draw.between(0.36, 0.5)
    lift, height = draw.between(0.08, 0.3), draw.between(0.42, 0.68)
    look, front = any_look(draw), -depth / 2
    parts = feet(draw, width, depth, lift, "tapered", "tapered", "square", "sledge", "plinth")
    parts += carcass((width, depth, height), (0, 0, lift))
    bays = 3 if width < 1.5 else draw.count(3, 4)
    each, middle = width / bays, draw.pick("drawers", "drawers", "open", "door")
    for k in range(bays):
        x, inner = each * (k + 0.5) - width / 2, 0 < k < bays - 1
        if k:
            parts.append(box((BOARD, depth - 0.01, height - 0.01), (x - each / 2, 0.005, lift)))
        if inner and middle == "drawers":
            rows = draw.count(2, 4)
            for r in range(rows):
                at = (x, front, lift + r * height / rows)
                parts += drawer(look, each, height / rows, depth, at, pulled=_pull(draw, depth))
        elif inner and middle == "open":
            parts.append(box((each, depth - 0.02, BOARD), (x, 0.01, lift + 0.5 * height)))
            for z in (lift + BOARD, lift + 0.5 * height + BOARD):
                room = (depth - 0.02, 0.44 * height)
                parts += contents(draw, x - 0.45 * each, x + 0.45 * each, front, z, room)
        else:
            hinge, angle = (-1 if k < bays / 2 else 1), _swing(draw, 0.12)
            parts += door(look, each, height, (x, front, lift), hinge=hinge, angle=angle)
    return parts + _top(draw, width, depth, lift + height)


def kitchen(draw: Draw) -> list[Mesh]:
    """Base units under a worktop with a recessed plinth, perhaps wall units above a splashback."""
    count, depth = draw.count(1, 3), draw.between(0.55, 0.62)
    each = draw.between(0.4, 0.62)
    width, lift, height = count * each, draw.between(0.1, 0.15), draw.between(0.68, 0.76)
    look, front = any_look(draw, "flat", "framed", "raised"), -depth / 2
    parts = [box((width - 0.01, depth - 0.1, lift), (0, 0.05, 0))]
    for k in range(count):
        x = each * (k + 0.5) - width / 2
        parts += carcass((each, depth, height), (x, 0, lift))
        if draw.chance(0.3):
            for r, share in enumerate((0.4, 0.4, 0.2)):
                at = (x, front, lift + 0.4 * r * height)
                parts += drawer(look, each, share * height, depth, at, pulled=_pull(draw, depth))
            continue
        low = height * draw.pick(1.0, 0.8)
        if low < height:
            at = (x, front, lift + low)
            parts += drawer(look, each, height - low, depth, at, pulled=_pull(draw, depth))
        hinge, angle = draw.pick(-1, 1), _swing(draw, 0.15)
        at = (x, front, lift)
        parts += door(look, each, low, at, hinge=hinge, angle=angle, grip_at=0.88)
    top = lift + height
    parts.append(box((width + 0.02, depth + 0.05, 0.038), (0, -0.025, top)))
    if draw.chance(0.3):
        shallow, rise, tall = 0.34, draw.between(0.45, 0.6), draw.between(0.5, 0.75)
        y, z = depth / 2 - shallow / 2, top + 0.038 + rise
        parts.append(box((width, 0.015, rise + tall), (0, depth / 2 + 0.007, top)))
        parts += carcass((width, shallow, tall), (0, y, z))
        parts += _doors(draw, look, width, tall, y - shallow / 2, z, count, grip_at=0.12)
    return parts


def media_console(draw: Draw) -> list[Mesh]:
    """A television stand: long and very low, open bays with devices beside doors or drawers."""
    width, depth = draw.between(0.9, 1.9), draw.between(0.34, 0.48)
    lift, height = draw.between(0.03, 0.16), draw.between(0.3, 0.46)
    look, front = any_look(draw), -depth / 2
    parts = feet(draw, width, depth, lift) + carcass((width, depth, height), (0, 0, lift))
    bays = draw.count(2, 4)
    each, mid = width / bays, lift + draw.between(0.45, 0.6) * height
    for k in range(bays):
        x = each * (k + 0.5) - width / 2
        if k:
            parts.append(box((BOARD, depth - 0.01, height - 0.01), (x - each / 2, 0.005, lift)))
        if draw.chance(0.4):
            parts += door(look, each, height, (x, front, lift), angle=_swing(draw, 0.15))
        elif draw.chance(0.4):
            for r in range(2):
                at = (x, front, lift + r * height / 2)
                parts += drawer(look, each, height / 2, depth, at, pulled=_pull(draw, depth))
        else:
            parts.append(box((each, depth - 0.03, BOARD), (x, 0.015, mid)))
            for z in (lift + BOARD, mid + BOARD):
                if draw.chance(0.6):  # a receiver, a player
                    size = (draw.between(0.5, 0.85) * each, 0.6 * depth, draw.between(0.04, 0.1))
                    parts.append(box(size, (x, 0, z)))
    return parts + _top(draw, width, depth, lift + height)


def filing(draw: Draw) -> list[Mesh]:
    """A steel filing cabinet: two to four deep drawers with label holders, or a pedestal."""
    width, depth = draw.between(0.38, 0.48), draw.between(0.5, 0.65)
    rows, unit, lift = draw.count(2, 4), draw.between(0.26, 0.34), draw.between(0.02, 0.07)
    columns, height = (2 if draw.chance(0.25) else 1), rows * unit
    look, front = Look("flat", draw.pick("cup", "bar", "bar"), 1.2), -depth / 2
    parts = feet(draw, columns * width, depth, lift, "plinth", "plinth", "square")
    for column in range(columns):
        x = width * (column + 0.5 - columns / 2)
        parts += carcass((width, depth, height), (x, 0, lift), board=0.015)
        for k in range(rows):
            at = (x, front, lift + k * unit)
            pulled = _pull(draw, depth, 0.2)
            parts += drawer(look, width - 0.02, unit, depth, at, pulled=pulled)
            label = (x, front - FRONT_M - pulled, at[2] + 0.78 * unit)
            parts.append(frame(0.09, 0.04, 0.008, 0.005, label))
            if pulled > 0.15:  # folders
                for j in range(draw.count(4, 10)):
                    y = front - pulled + 0.02 + j * 0.03
                    parts.append(box((width - 0.09, 0.006, 0.8 * unit), (x, y, at[2] + 0.03)))
    lock = (columns * width / 2 - 0.05, front, lift + height)
    parts.append(box((columns * width, depth + FRONT_M, 0.02), (0, -FRONT_M / 2, lift + height)))
    return parts + grip(Look("flat", "knob", 0.6), (lock[0], lock[1] - 0.02, lock[2] - 0.04))


def glass_door(draw: Draw) -> list[Mesh]:
    """A display cabinet: framed glass doors, often half open, over shelves with china."""
    count, depth = draw.count(1, 2), draw.between(0.32, 0.45)
    width, height = count * draw.between(0.4, 0.55), draw.between(1.1, 1.9)
    lift, front = draw.between(0.05, 0.2), -depth / 2
    look, solid = any_look(draw, "glass"), any_look(draw, "flat", "raised", "framed")
    parts = feet(draw, width, depth, lift) + carcass((width, depth, height), (0, 0, lift))
    low = height * draw.between(0.2, 0.35) if draw.chance(0.5) else 0.0
    if low:
        parts += _doors(draw, solid, width, low, front, lift, count, odds=0.1)
        parts.append(box((width - BOARD, depth - 0.01, BOARD), (0, 0.005, lift + low - BOARD)))
    shelves = draw.count(3, 5)
    base, pitch = lift + low, (height - low) / shelves
    for k in range(shelves):
        z = base + k * pitch
        parts.append(box((width - BOARD, depth - 0.04, BOARD), (0, 0.01, z)))
        for x in (-0.3, 0.0, 0.3):
            if draw.chance(0.5):
                size = (draw.between(0.08, 0.13), 0.1, draw.between(0.06, 0.6 * pitch))
                parts.append(ellipsoid(size, (x * width, 0.02, z + BOARD + size[2] / 2)))
    parts += _doors(draw, look, width, height - low, front, base, count, odds=0.6)
    return parts + _top(draw, width, depth, lift + height)


def hutch(draw: Draw) -> list[Mesh]:
    """A buffet in two parts: a deep lower cabinet and a shallower upper one, often pedimented."""
    width, depth = draw.between(0.8, 1.5), draw.between(0.42, 0.55)
    lift, low, high = draw.between(0.04, 0.12), draw.between(0.65, 0.85), draw.between(0.8, 1.15)
    count, upper = (2 if width < 1.15 else draw.count(2, 3)), draw.between(0.55, 0.75) * depth
    look = any_look(draw, "raised", "framed", "flat")
    above = Look(draw.pick("raised", "framed", "glass", look.front), look.grip, look.scale)
    parts = feet(draw, width, depth, lift, "plinth", "bun", "square")
    parts += carcass((width, depth, low), (0, 0, lift))
    split = low * draw.between(0.7, 0.82)
    for k in range(count):
        at = (width * ((k + 0.5) / count - 0.5), -depth / 2, lift + split)
        parts += drawer(look, width / count, low - split, depth, at, pulled=_pull(draw, depth))
    parts += _doors(draw, look, width, split, -depth / 2, lift, count, odds=0.1)
    parts += _top(draw, width, depth, lift + low)
    y, z = (depth - upper) / 2, lift + low + 0.02
    niche = draw.between(0.15, 0.3) if draw.chance(0.5) else 0.0
    narrow = width - draw.pick(0.0, 0.06)
    parts += carcass((narrow, upper, high), (0, y, z))
    for k in range(4):
        level = z + niche + k * (high - niche) / 4
        parts.append(box((narrow - BOARD, upper - 0.02, BOARD), (0, y + 0.01, level)))
        room = (upper, (high - niche) / 4 - BOARD)
        inner = narrow / 2 - BOARD
        parts += contents(draw, -inner, inner, y - upper / 2 + 0.01, level + BOARD, room, 0.4)
    parts += _doors(
        draw, above, narrow, high - niche, y - upper / 2, z + niche, count, grip_at=0.35
    )
    if draw.chance(0.5):
        half, rise = narrow / 2 + 0.03, draw.between(0.05, 0.18)
        outline = [(-half, 0), (half, 0), (half, 0.03), (0, rise), (-half, 0.03)]
        parts.append(move(extrude(outline, upper, "y"), (0, y - upper / 2, z + high)))
    return parts


FAMILIES: tuple[Family, ...] = (
    train(night_stand),
    train(chest_of_drawers),
    train(wardrobe),
    train(sideboard),
    train(kitchen),
    train(media_console),
    test(filing),
    test(glass_door),
    test(hutch),
)
