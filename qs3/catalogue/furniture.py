"""What chairs, tables, sofas and others share: legs, bent tubes, curved backs, upholstery."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qs3.catalogue import parts as p
from qs3.meshes.mesh import Mesh


def both_sides(mesh: Mesh) -> list[Mesh]:
    """A part and its mirror image across the plane x = 0."""
    return [mesh, p.mirrored(mesh)]


def post(
    path: Sequence[p.Vector], section: np.ndarray, scale: Sequence[float] | None = None
) -> Mesh:
    """A leg whose cross-sections stay level, so that it stands flat on the floor.

    `section` is an outline [N, 2]; `path` leads from bottom to top, `scale` is one for each of its
    points.
    """
    factors = [1.0] * len(path) if scale is None else scale
    pairs = zip(path, factors, strict=True)
    return p.loft(np.stack([p.ring_at(section * f, 0.0) + np.asarray(at) for at, f in pairs]))


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

    `section` is their outline [N, 2] at the upper end, `foot` its scale at the floor; each foot
    stands out by `splay` along x and along y.
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
