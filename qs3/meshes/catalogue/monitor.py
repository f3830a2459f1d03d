"""Monitors: flat screens on stands, tubes, televisions, all-in-ones, several on an arm."""

from __future__ import annotations

import numpy as np

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.catalogue.family import Family, test, train
from qs3.meshes.catalogue.parts import (
    arc,
    beam,
    box,
    cylinder,
    ellipse,
    extrude,
    frustum,
    loft,
    mirrored,
    move,
    rectangle,
    rod,
    rounded_box,
    rounded_rectangle,
    slab,
    sweep,
    tube,
    turn,
)
from qs3.meshes.mesh import Mesh


def _plate(curve: np.ndarray, thickness: float) -> Mesh:
    """A star-shaped plate upright about the origin, its front at y = 0."""
    return turn(slab(curve, thickness), -90, "x")


def _panel(draw: Draw, width: float, height: float, chin: float = 0.0) -> list[Mesh]:
    """A flat screen about the origin facing -y: bezel, body, bulge with vents behind."""
    depth, bezel = draw.between(0.012, 0.035), draw.between(0.007, 0.028)
    lip = draw.between(0.002, 0.006)
    radius = draw.between(0.002, 0.015)
    parts = [_plate(rounded_rectangle(width, height, radius), depth)]
    below = bezel + chin
    for size, x, z in [
        ((width, lip + 0.004, bezel), 0.0, 0.5 * height - bezel),
        ((width, lip + 0.004, below), 0.0, -0.5 * height),
        ((bezel, lip + 0.004, height), -0.5 * (width - bezel), -0.5 * height),
        ((bezel, lip + 0.004, height), 0.5 * (width - bezel), -0.5 * height),
    ]:
        parts.append(box(size, (x, 0.5 * (0.004 - lip), z)))
    bulge = draw.between(0.01, 0.05)
    w, h = draw.between(0.45, 0.85) * width, draw.between(0.4, 0.75) * height
    back = frustum((w, h), (0.8 * w, 0.75 * h), bulge)
    shift = -draw.between(0.0, 0.1) * height
    parts.append(move(turn(back, -90, "x"), (0, depth - 0.002, shift)))
    if draw.chance(0.5):
        for k in range(draw.count(3, 6)):
            z = shift + 0.06 * h * k
            parts.append(box((0.5 * w, 0.006, 0.025 * h), (0, depth + bulge, z)))
    return parts


def _size(draw: Draw, low: float, high: float) -> tuple[float, float]:
    """Width and height of a screen whose diagonal is given in metres."""
    diagonal, ratio = draw.between(low, high), draw.pick(16 / 9, 16 / 9, 16 / 10, 5 / 4, 4 / 3)
    height = diagonal / np.hypot(ratio, 1)
    return float(ratio * height), float(height)


def _place(parts: list[Mesh], tilt: float, z: float, y: float = 0.0) -> list[Mesh]:
    """Lean a panel back by `tilt` degrees and lift its centre to z."""
    return [move(turn(part, -tilt, "x"), (0, y, z)) for part in parts]


def _foot(draw: Draw, width: float) -> list[Mesh]:
    """What stands on the desk: a plate, an oval, a ring plate or two spread legs."""
    depth, h = draw.between(0.16, 0.24), draw.between(0.008, 0.02)
    kind = draw.count(0, 3)
    if kind == 0:
        return [slab(rounded_rectangle(width, depth, 0.03), h)]
    if kind == 1:
        return [slab(ellipse(width, depth, 32), h), slab(ellipse(0.4 * width, 0.09, 24), 2.2 * h)]
    if kind == 2:
        return [frustum((width, depth), (0.85 * width, 0.7 * depth), 1.5 * h)]
    parts = [cylinder(0.035, 0.03)]
    for side in (-1, 1):
        end = (side * 0.5 * width, -0.55 * depth, 0.008)
        parts.append(beam((0, 0.02, 0.015), end, (0.035, 0.016), 0.6))
        parts.append(beam((0, 0, 0.015), (0.5 * end[0], 0.5 * depth, 0.008), (0.035, 0.016), 0.6))
    return parts


def flat_stand(draw: Draw) -> list[Mesh]:
    """The office monitor: a panel on a neck and a foot."""
    width, height = _size(draw, 0.43, 0.75)
    clear, tilt = draw.between(0.05, 0.2), draw.between(-3, 18)
    centre = clear + 0.5 * height
    back = draw.between(0.06, 0.1)
    neck = draw.between(0.04, 0.09)
    parts = _place(_panel(draw, width, height), tilt, centre)
    top = (0, back, centre + draw.between(-0.05, 0.03))
    parts.append(beam((0, back + draw.between(0, 0.03), 0.005), top, (neck, 0.025)))
    hinge = move(turn(cylinder(0.025, 1.3 * neck, (0, 0, -0.65 * neck)), 90, "y"), top)
    plate = beam((0, back, top[2]), (0, 0.02, centre), (0.1, 0.09))
    foot = [move(part, (0, 0.7 * back, 0)) for part in _foot(draw, draw.between(0.35, 0.5) * width)]
    return [*parts, hinge, plate, *foot]


def crt(draw: Draw) -> list[Mesh]:
    """A tube: a deep body that narrows backwards, a bulged glass, a swivel foot."""
    width, height = draw.between(0.34, 0.5), draw.between(0.32, 0.44)
    depth, mask = draw.between(0.34, 0.48), draw.between(0.06, 0.14)
    clear = draw.between(0.03, 0.08)
    parts = _tube_body(draw, width, height, depth, mask)
    parts = _place(parts, draw.between(0, 8), clear + 0.5 * height)
    y = 0.45 * depth
    parts.append(cylinder(0.28 * width, 0.025, (0, y, 0), top=0.25 * width, sides=24))
    parts.append(cylinder(0.16 * width, clear + 0.06, (0, y, 0.02), sides=20))
    return parts


def _tube_body(draw: Draw, width: float, height: float, depth: float, mask: float) -> list[Mesh]:
    """Front frame, glass and tapered back of a tube, about the origin, its front at y = 0."""
    shape = rounded_rectangle(width, height, 0.02)
    narrow, low = draw.between(0.5, 0.72), draw.between(0.0, 0.12) * height
    stages = [(1.0, 0.0), (1.0, mask), (0.88, mask + 0.02), (narrow, 0.85 * depth)]
    stages.append((0.9 * narrow, depth))
    rings = []
    for scale, y in stages:
        drop = low * (1 - scale) / (1 - narrow)
        rings.append(np.column_stack([shape[:, 0] * scale, np.full(len(shape), y), shape[:, 1]]))
        rings[-1][:, 2] = shape[:, 1] * scale - drop
    frame = draw.between(0.025, 0.045)
    glass_w, glass_h = width - 2 * frame, height - 2 * frame - 0.02
    parts = [loft(np.stack(rings))]
    bulge = []
    for scale, y in [(1.0, 0.01), (1.0, 0.0), (0.8, -0.007), (0.5, -0.013), (0.2, -0.016)]:
        flat = rounded_rectangle(glass_w * scale, glass_h * scale, 0.04 * scale)
        bulge.append(np.column_stack([flat[:, 0], np.full(len(flat), y), flat[:, 1] + 0.012]))
    parts.append(loft(np.stack(bulge)))
    lip = draw.between(0.012, 0.025)
    for side in (-1, 1):
        x = side * 0.5 * (width - frame)
        parts.append(box((frame, lip + 0.01, height), (x, 0.005 - 0.5 * lip, -0.5 * height)))
    parts.append(box((width, lip + 0.01, frame), (0, 0.005 - 0.5 * lip, 0.5 * height - frame)))
    chin = frame + 0.022
    parts.append(box((width, lip + 0.01, chin), (0, 0.005 - 0.5 * lip, -0.5 * height)))
    for k in range(draw.count(0, 5)):
        parts.append(box((0.014, 0.01, 0.008), (0.03 * k, -lip - 0.002, 0.01 - 0.5 * height)))
    return parts


def tv_feet(draw: Draw) -> list[Mesh]:
    """A wide flat television on two feet."""
    diagonal = draw.between(0.75, 1.45)
    width, height = 0.872 * diagonal, 0.49 * diagonal
    clear = draw.between(0.05, 0.09)
    parts = _place(_panel(draw, width, height), 0, clear + 0.5 * height)
    x, reach = draw.between(0.25, 0.44) * width, draw.between(0.1, 0.15)
    if draw.chance(0.5):
        foot = [
            beam((x, 0.01, clear + 0.02), (x + 0.02, -reach, 0.006), (0.022, 0.012)),
            beam((x, 0.01, clear + 0.02), (x + 0.02, reach, 0.006), (0.022, 0.012)),
        ]
    else:
        foot = [
            box((0.025, 2 * reach, 0.012), (x, 0.01, 0)),
            box((0.02, 0.02, clear + 0.03), (x, 0.015, 0)),
        ]
    parts += foot + [mirrored(part) for part in foot]
    if draw.chance(0.2):
        parts.append(rounded_box((0.7 * width, 0.08, 0.05), (0, -0.12, 0), radius=0.015))
    return parts


def all_in_one(draw: Draw) -> list[Mesh]:
    """A panel with a chin on one bent sheet of metal."""
    width, height = _size(draw, 0.55, 0.78)
    chin, clear = draw.between(0.05, 0.09), draw.between(0.05, 0.12)
    centre, sheet = clear + 0.5 * (height + chin), draw.between(0.14, 0.22)
    parts = _place(_panel(draw, width, height + chin, chin), draw.between(2, 10), centre)
    front, back = -draw.between(0.08, 0.12), draw.between(0.07, 0.12)
    bend = arc((0, 0.6 * back, 0.006), (0, back, 0.006), (0, 0.9 * back, 0.07), 6)
    path = np.concatenate([[(0, front, 0.006)], bend, [(0, 0.03, centre + 0.02)]])
    parts.append(sweep(rectangle(sheet, 0.01), path))
    return parts


def portrait(draw: Draw) -> list[Mesh]:
    """An office monitor turned upright on a tall column."""
    height, width = _size(draw, 0.5, 0.7)
    clear = draw.between(0.03, 0.12)
    centre, back = clear + 0.5 * height, draw.between(0.07, 0.11)
    parts = _place(_panel(draw, width, height), draw.between(-2, 8), centre)
    column = centre + draw.between(0.02, 0.12)
    if draw.chance(0.5):
        parts.append(cylinder(draw.between(0.016, 0.028), column, (0, back, 0.0), sides=16))
    else:
        parts.append(box((0.06, 0.03, column), (0, back, 0.0)))
    parts.append(beam((0, back, centre), (0, 0.02, centre), (0.1, 0.1)))
    foot = _foot(draw, draw.between(0.22, 0.32))
    return parts + [move(part, (0, 0.5 * back, 0)) for part in foot]


def tv_pedestal(draw: Draw) -> list[Mesh]:
    """An older, thick television: loudspeakers beside or below the screen, a broad foot."""
    diagonal = draw.between(0.65, 1.15)
    width, height = 0.872 * diagonal, 0.49 * diagonal
    clear, thick = draw.between(0.05, 0.1), draw.between(0.06, 0.12)
    below = draw.chance(0.6)
    box_w, box_h = (width, height + 0.08) if below else (width + 0.22, height)
    z = clear + 0.5 * box_h
    body = rounded_box((box_w, box_h, thick), radius=0.02)
    parts = [move(turn(body, -90, "x"), (0, 0, z))]
    parts += _place(_panel(draw, width - 0.01, height - 0.01), 0, z + (0.04 if below else 0), -0.01)
    if below:
        parts.append(box((0.8 * width, 0.02, 0.045), (0, -0.004, clear + 0.015)))
    else:
        for x in (-0.5 * (width + 0.11), 0.5 * (width + 0.11)):
            parts.append(box((0.07, 0.02, 0.85 * height), (x, -0.004, clear + 0.075 * height)))
    back = frustum((0.7 * box_w, 0.7 * box_h), (0.5 * box_w, 0.5 * box_h), 0.06)
    parts.append(move(turn(back, -90, "x"), (0, thick - 0.01, z)))
    parts.append(box((draw.between(0.12, 0.4) * width, 0.06, clear + 0.03), (0, 0.5 * thick, 0.01)))
    foot_w, foot_d = draw.between(0.45, 0.7) * width, draw.between(0.22, 0.3)
    shape = draw.pick(ellipse(foot_w, foot_d, 32), rounded_rectangle(foot_w, foot_d, 0.04))
    return [*parts, slab(shape, 0.025, (0, 0.5 * thick, 0))]


def curved(draw: Draw) -> list[Mesh]:
    """A curved ultrawide screen on spread legs."""
    width = draw.between(0.75, 1.15)
    height, radius = width * draw.between(0.38, 0.48), draw.between(0.8, 1.6)
    clear, thick = draw.between(0.06, 0.16), draw.between(0.02, 0.035)
    z = clear + 0.5 * height
    parts = [_bow(radius, width, (thick, height), z, 0.0)]
    bezel, lip = draw.between(0.006, 0.014), draw.between(0.003, 0.006)
    for level in (z + 0.5 * (height - bezel), z - 0.5 * (height - bezel)):
        parts.append(_bow(radius, width, (thick, bezel), level, -lip))
    parts.append(_bow(radius, 0.6 * width, (0.03, 0.5 * height), z, thick))
    back = draw.between(0.08, 0.13)
    parts.append(beam((0, back, z), (0, thick, z), (0.11, 0.11)))
    parts.append(beam((0, back + 0.03, 0), (0, back, z + 0.06), (0.06, 0.04)))
    reach = draw.between(0.22, 0.34) * width
    for side in (-1, 1):
        front = (side * reach, -draw.between(0.08, 0.12), 0.008)
        parts.append(beam((0, back + 0.03, 0.014), front, (0.035, 0.018), 0.6))
    parts.append(beam((0, back, 0.014), (0, back + 0.1, 0.008), (0.035, 0.018), 0.6))
    return parts


def _bow(radius: float, width: float, section: tuple[float, float], z: float, y: float) -> Mesh:
    """A bar bent like the screen: the middle at y, the ends nearer to the viewer."""
    angle = np.linspace(-0.5, 0.5, 13) * width / radius
    path = np.column_stack(
        [
            radius * np.sin(angle),
            y - radius * (1 - np.cos(angle)) + 0.5 * section[0],
            np.full(13, z),
        ]
    )
    return sweep(rectangle(*section), path)


def dual_arm(draw: Draw) -> list[Mesh]:
    """Two or three screens on one pole with arms."""
    count = draw.pick(2, 2, 2, 3)
    width, height = _size(draw, 0.48, 0.62)
    centre = 0.5 * height + draw.between(0.08, 0.2)
    pole = centre + draw.between(0.03, 0.15)
    back = draw.between(0.14, 0.2)
    parts = [cylinder(draw.between(0.016, 0.022), pole, (0, back, 0), sides=16)]
    parts.append(slab(rounded_rectangle(draw.between(0.22, 0.36), 0.24, 0.02), 0.014, (0, back, 0)))
    inward = draw.between(5, 22)
    seed_panel = _place(_panel(draw, width, height), draw.between(0, 6), 0)
    for k in range(count):
        side = k - 0.5 * (count - 1)
        x = side * (width * np.cos(np.radians(inward)) + 0.02)
        y = -(abs(side) ** 2) * width * np.sin(np.radians(inward)) * 0.9
        parts += [move(turn(part, -inward * side * 1.3), (x, y, centre)) for part in seed_panel]
        elbow = (0.5 * x, 0.6 * back + 0.02, centre)
        parts.append(rod((0, back, centre), elbow, 0.014))
        parts.append(rod(elbow, (x, y + 0.035, centre), 0.014))
        parts.append(cylinder(0.022, 0.05, (elbow[0], elbow[1], centre - 0.025)))
    parts.append(cylinder(0.03, 0.05, (0, back, centre - 0.025)))
    return parts


def crt_on_case(draw: Draw) -> list[Mesh]:
    """A tube on its flat computer case."""
    case_w, case_d, case_h = draw.between(0.38, 0.46), draw.between(0.36, 0.44), 0.1
    case_h *= draw.between(0.9, 1.5)
    width = case_w * draw.between(0.8, 0.98)
    height, depth = width * draw.between(0.8, 0.92), case_d * draw.between(0.8, 1.0)
    parts = [box((case_w, case_d, case_h), (0, 0.5 * case_d, 0))]
    parts.append(box((0.96 * case_w, 0.03, 0.9 * case_h), (0, -0.006, 0.05 * case_h)))
    for k in range(draw.count(1, 2)):
        slot = (0.15, 0.02, 0.022)
        parts.append(box(slot, (0.24 * case_w, -0.02, case_h * (0.2 + 0.4 * k))))
    parts.append(cylinder(0.3 * width, 0.035, (0, 0.45 * case_d, case_h - 0.004), sides=24))
    tube_parts = _tube_body(draw, width, height, depth, draw.between(0.06, 0.12))
    return parts + _place(tube_parts, draw.between(0, 7), case_h + 0.035 + 0.5 * height, 0.03)


def leaning(draw: Draw) -> list[Mesh]:
    """A touch or drawing display that leans far back on a wedge, a strut or a wire."""
    width, height = _size(draw, 0.35, 0.65)
    lean = draw.between(22, 48)
    angle = np.radians(lean)
    z = 0.5 * height * np.cos(angle) + draw.between(0.004, 0.03)
    parts = _place(_panel(draw, width, height), lean, z)
    up = np.array([0, np.sin(angle), np.cos(angle)])
    behind = np.array([0, np.cos(angle), -np.sin(angle)])
    hook = np.array([0, 0, z]) + 0.2 * height * up + 0.008 * behind
    foot_y = float(hook[1]) + draw.between(0.04, 0.12)
    kind = draw.count(0, 2)
    if kind == 0:
        toe = -0.5 * height * np.sin(angle)
        wedge = [(toe + 0.05, 0.0), (foot_y, 0.0), (hook[1], hook[2])]
        w = draw.between(0.25, 0.6) * width
        parts.append(move(extrude(np.array(wedge), w, "x"), (-0.5 * w, 0, 0)))
    elif kind == 1:
        parts.append(beam(hook, (0, foot_y, 0.006), (draw.between(0.1, 0.5) * width, 0.012)))
        plate = rounded_rectangle(0.4 * width, foot_y + 0.1, 0.02)
        parts.append(slab(plate, 0.012, (0, 0.5 * foot_y - 0.05, 0)))
        parts.append(beam((0, 0.0, 0.01), (0, 0.02, z), (0.06, 0.02)))
    else:
        x = draw.between(0.2, 0.4) * width
        legs = [(-x, *hook[1:]), (-x, foot_y, 0.006), (x, foot_y, 0.006), (x, *hook[1:])]
        parts.append(tube(np.array(legs), 0.007))
    return parts


FAMILIES: tuple[Family, ...] = (
    train(flat_stand),
    train(crt),
    train(tv_feet),
    train(all_in_one),
    train(portrait),
    train(tv_pedestal),
    test(curved),
    test(dual_arm),
    test(crt_on_case),
    test(leaning),
)
