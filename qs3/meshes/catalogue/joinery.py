"""Boards, fronts, feet and books: what cabinets and bookshelves are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.parts import (
    ORIGIN,
    Vector,
    box,
    cylinder,
    ellipsoid,
    frustum,
    lathe,
    loft,
    move,
    rectangle,
    rod,
    rounded_box,
    turn,
)
from qs3.meshes.mesh import Mesh

FRONT_M = 0.02  # thickness of doors and drawer fronts
GAP_M = 0.004  # between neighbouring fronts


@dataclass(frozen=True)
class Look:
    """What all fronts of one piece have in common.

    Attributes:
        front: "flat", "framed", "raised", "slatted" or "glass".
        grip: "knob", "bar", "cup" or "none".
        scale: size of the grips, about 1.
    """

    front: str
    grip: str
    scale: float = 1.0


def any_look(draw: Draw, *fronts: str) -> Look:
    """A look with one of the given fronts (any but glass, if none is given)."""
    front = draw.pick(*(fronts or ("flat", "flat", "framed", "raised", "slatted")))
    return Look(front, draw.pick("knob", "knob", "bar", "cup", "none"), draw.between(0.8, 1.3))


def carcass(
    size: Vector, at: Vector = ORIGIN, board: float = 0.02, back: bool = True
) -> list[Mesh]:
    """Sides, bottom, top and perhaps a back: an open case of (width, depth, height)."""
    width, depth, height = (float(s) for s in size)
    inner = width - 2 * board
    parts = [
        box((board, depth, height), (s * (width - board) / 2, 0, 0)) for s in (-1, 1)
    ]  # the sides carry top and bottom
    parts += [box((inner, depth, board), (0, 0, z)) for z in (0, height - board)]
    if back:
        parts.append(box((inner, 0.008, height), (0, depth / 2 - 0.004, 0)))
    return [move(p, at) for p in parts]


def frame(width: float, height: float, border: float, thickness: float, at: Vector) -> Mesh:
    """An upright picture frame; `at` is the middle of its lower back edge."""
    inner, outer = (rectangle(width - 2 * b, height - 2 * b) for b in (border, 0.0))
    rings = [
        np.column_stack([c[:, 0], np.full(4, y), c[:, 1] + height / 2])
        for c, y in [(outer, 0), (outer, -thickness), (inner, -thickness), (inner, 0)]
    ]
    return loft(np.stack(rings) + np.asarray(at, dtype=np.float64), loop=True)


def grip(look: Look, at: Vector, upright: bool = False, span: float = 0.13) -> list[Mesh]:
    """A handle on a front; `at` is the point of the front's face where it sits."""
    s = look.scale
    if look.grip == "knob":
        stem = turn(cylinder(0.007 * s, 0.02 * s, sides=8), 90, "x")
        ball = ellipsoid((0.03 * s, 0.022 * s, 0.03 * s), (0, -0.025 * s, 0), sides=10, rings=5)
        return [move(stem, at), move(ball, at)]
    if look.grip == "bar":
        half = 0.5 * span * s
        parts = [rod((-half, -0.03, 0), (half, -0.03, 0), 0.006 * s, sides=6)]
        for x in (-0.8 * half, 0.8 * half):
            parts.append(rod((x, 0.002, 0), (x, -0.03, 0), 0.005 * s, sides=6))
        return [move(turn(p, 90 if upright else 0, "y"), at) for p in parts]
    if look.grip == "cup":
        cup = frustum((0.09 * s, 0.03 * s), (0.06 * s, 0.012 * s), 0.03 * s, (0, -0.015 * s, 0))
        return [move(cup, at)]
    return []


def panel(look: Look, width: float, height: float, at: Vector) -> list[Mesh]:
    """A front without its handle; `at` is the middle of its lower back edge."""
    width, height = width - GAP_M, height - GAP_M
    x, y, z = (float(c) for c in at)
    z += GAP_M / 2
    border = min(0.06, 0.22 * min(width, height))
    if look.front == "flat":
        return [box((width, FRONT_M, height), (x, y - FRONT_M / 2, z))]
    if look.front == "raised":
        inset = (width - 2 * border, 0.03, height - 2 * border)
        return [
            box((width, FRONT_M, height), (x, y - FRONT_M / 2, z)),
            rounded_box(inset, (x, y - 0.018, z + border), radius=0.008, steps=1),
        ]
    parts = [frame(width, height, border, FRONT_M + 0.005, (x, y, z))]
    if look.front == "slatted":
        count = max(2, int((height - 2 * border) / 0.045))
        pitch = (height - 2 * border) / count
        for k in range(count):
            slat = turn(box((width - 2 * border, 0.006, 1.1 * pitch)), 22, "x")
            parts.append(move(slat, (x, y - 0.008, z + border + k * pitch)))
    elif look.front == "framed":
        parts.append(box((width - 0.01, 0.01, height - 0.01), (x, y - 0.006, z + 0.005)))
    else:  # glass, which a depth sensor looks through: only its bars are there
        for k in range(1, 1 + int(height / 0.45)):
            bar = (width - border, 0.012, 0.02)
            parts.append(box(bar, (x, y - 0.012, z + height * k / (1 + int(height / 0.45)))))
    return parts


def door(
    look: Look,
    width: float,
    height: float,
    at: Vector,
    *,
    hinge: int = -1,
    angle: float = 0.0,
    grip_at: float = 0.5,
) -> list[Mesh]:
    """A door before a case whose front is at `at` (lower middle), hung left (-1) or right (1).

    `angle` opens it by degrees; `grip_at` is the height of its handle as a fraction.
    """
    x, y, z = (float(c) for c in at)
    parts = panel(look, width, height, at)
    spot = (x - hinge * (width / 2 - 0.035), y - FRONT_M, z + grip_at * height)
    parts += grip(look, spot, upright=True)
    if angle:
        parts = [turn(p, hinge * angle, "z", (x + hinge * width / 2, y, z)) for p in parts]
    return parts


def drawer(
    look: Look,
    width: float,
    height: float,
    depth: float,
    at: Vector,
    *,
    pulled: float = 0.0,
    grips: int = 1,
) -> list[Mesh]:
    """A drawer whose closed front stands before `at`; its box is made when it is pulled out."""
    x, y, z = (float(c) for c in at)
    parts = panel(look, width, height, at)
    for k in range(grips):
        spot = x + width * ((k + 0.5) / grips - 0.5)
        parts += grip(look, (spot, y - FRONT_M, z + 0.55 * height), span=min(0.13, 0.5 * width))
    if pulled > 0:
        w, h = width - 0.05, 0.75 * height
        parts.append(box((w, depth - 0.03, 0.01), (x, y + depth / 2 - 0.015, z + 0.02)))
        for s in (-1, 1):
            side = (x + s * (w / 2 - 0.006), y + depth / 2 - 0.015, z + 0.02)
            parts.append(box((0.012, depth - 0.03, h), side))
        parts.append(box((w, 0.012, h), (x, y + depth - 0.036, z + 0.02)))
    return [move(p, (0, -pulled, 0)) for p in parts]


def feet(draw: Draw, width: float, depth: float, height: float, *kinds: str) -> list[Mesh]:
    """Something to stand on, from the floor up to `height`, under a case at the origin."""
    kind = draw.pick(*(kinds or ("plinth", "square", "tapered", "bun", "sledge")))
    if kind == "plinth":
        return [box((width - 0.01, depth - 0.06, height), (0, 0.03, 0))]
    inset = draw.between(0.0, 0.06) + 0.03
    corners = [
        (sx * (width / 2 - inset), sy * (depth / 2 - inset)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    thick = draw.between(0.03, 0.05)
    if kind == "square":
        return [box((thick, thick, height), (x, y, 0)) for x, y in corners]
    if kind == "bun":
        bulge = [(0.5, 0), (0.9, 0.3), (1, 0.55), (0.75, 0.9), (0.6, 1)]
        profile = [(1.1 * thick * r, height * t) for r, t in bulge]
        return [lathe(profile, (x, y, 0), sides=12) for x, y in corners]
    if kind == "sledge":
        bars = [
            box((0.025, depth - 0.05, 0.025), (sx * (width / 2 - inset), 0, 0)) for sx in (-1, 1)
        ]
        return bars + [box((0.025, 0.025, height), (x, y, 0)) for x, y in corners]
    splay = draw.between(0.0, 0.35) * height
    return [
        frustum(
            (0.5 * thick,) * 2,
            (thick,) * 2,
            height,
            (x + splay * np.sign(x), y + 0.5 * splay * np.sign(y), 0),
            (-splay * float(np.sign(x)), -0.5 * splay * float(np.sign(y))),
        )
        for x, y in corners
    ]


def books(
    draw: Draw, left: float, right: float, front: float, z: float, room: Vector
) -> list[Mesh]:
    """A row of standing books from `left` on; room is the (depth, height) of the compartment."""
    depth, height = (float(r) for r in room)
    tall, thick = min(0.95 * height, draw.between(0.2, 0.34)), draw.between(0.02, 0.045)
    parts, x = [], left + 0.002
    while x < right - 0.06:
        t = thick * draw.between(0.5, 1.5)
        size = (t, min(depth - 0.01, draw.between(0.13, 0.22)), tall * draw.between(0.72, 1.0))
        start = front + draw.between(0.005, 0.02)
        parts.append(box(size, (x + t / 2, start + size[1] / 2, z)))
        x += t + 0.001
    if draw.chance(0.5) and parts:
        angle, size = draw.between(8, 20), (0.025, min(depth - 0.01, 0.16), 0.8 * tall)
        foot = x + size[2] * float(np.sin(np.radians(angle)))
        if foot + 0.03 < right + 0.05:
            leaning = box(size, (foot + 0.0125, front + 0.01 + size[1] / 2, z))
            parts.append(turn(leaning, -angle, "y", (foot, 0, z)))
    return parts


def contents(
    draw: Draw, left: float, right: float, front: float, z: float, room: Vector, fill: float = 0.7
) -> list[Mesh]:
    """What stands in one compartment: books mostly, some things, or nothing (1 - fill)."""
    if not draw.chance(fill):
        return []
    depth, height = (float(r) for r in room)
    width = right - left
    kind = draw.pick("books", "books", "books", "row", "pile", "vase", "basket", "boxes")
    middle = (draw.between(left + 0.35 * width, right - 0.35 * width), front + 0.5 * depth, z)
    if kind == "books":
        return books(draw, left, right, front, z, room)
    if kind == "row":
        return books(draw, left, left + draw.between(0.4, 0.8) * width, front, z, room)
    if kind == "pile":
        parts, level = [], 0.0
        for _ in range(draw.count(2, 6)):
            size = (draw.between(0.17, 0.28), draw.between(0.14, 0.2), draw.between(0.015, 0.04))
            size = (min(size[0], 0.6 * width), min(size[1], 0.9 * depth), size[2])
            if level + size[2] > height:
                break
            lying = turn(box(size), draw.between(-6, 6))
            parts.append(move(lying, (middle[0], middle[1], z + level)))
            level += size[2]
        return parts
    if kind == "vase":
        r = min(0.3 * depth, 0.25 * width, 0.09)
        tall = min(0.85 * height, draw.between(0.12, 0.32))
        shape = [(0.6, 0), (1.0, 0.35), (0.9, 0.6), (0.35, 0.85), (0.5, 1), (0.4, 1), (0.25, 0.85)]
        return [lathe([(s * r, t * tall) for s, t in shape], middle, sides=14)]
    if kind == "basket":
        w, h = min(0.85 * width, 0.4), min(0.75 * height, 0.24)
        spot = (left + 0.5 * width, front + 0.48 * depth, z)
        return [frustum((0.85 * w, 0.8 * depth), (w, 0.9 * depth), h, spot)]
    sizes = [min(0.4 * width, 0.3), 0.8 * depth, min(0.6 * height, draw.between(0.1, 0.25))]
    return [box(sizes, (left + 0.3 * width, middle[1], z))]
