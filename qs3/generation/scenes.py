"""What stands around the object: nothing (the paper), or a floor with clutter and occluders."""

from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge

from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body
from qs3.utils.settings import Share, settings

HAIR_M = 1e-4
"""What an object stands on is so far below it: its bottom face is in no other face's plane."""


@runtime_checkable
class Surroundings(Protocol):
    """What stands around the object."""

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object first (label 1), then the rest (label 0)."""
        ...


@settings
class Alone:
    """The object floats in the dark, as in the paper."""

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object, with the default albedo."""
        return (Body(mesh, albedo=0.8, label=1),)


@settings
class Room:
    """The object stands on a floor, maybe before a wall, among boxes and cylinders."""

    wall: Share = 0.5  # probability of one behind the object
    max_clutter: Annotated[int, Ge(0)] = 5  # pieces around the object
    max_occluders: Annotated[int, Ge(0)] = 2  # pieces close to it, which hide a part of it
    min_albedo: Share = 0.25  # of every body, drawn for each
    max_albedo: Share = 0.9

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object, the floor, and the rest.

        Args:
            mesh: the object, placed.
            eyes_m: [V, 3] where the cameras will be; nothing is put there, and the wall is behind
                the object as seen from their mean: on a long walk around a small object it can
                stand before one of them (in 0.25 % of the views of objects of 0.3 m).
            rng: of the scene.
        """
        low, high = mesh.bounds
        centre, half = (low + high) / 2, (high - low) / 2
        radius = float(np.hypot(half[0], half[1]))
        floor = float(low[2])

        rest = [_quad(centre, floor, 6.0)]
        if rng.random() < self.wall:
            behind = centre[:2] - eyes_m[:, :2].mean(axis=0)
            angle = np.arctan2(behind[1], behind[0]) + rng.uniform(-0.6, 0.6)
            rest.append(_wall(centre, radius + rng.uniform(0.02, 0.6), floor, angle))
        pieces = []
        for _ in range(int(rng.integers(0, self.max_clutter + 1))):
            away = radius + rng.uniform(0.25, 1.2)
            pieces.append(_piece(centre, away, floor, rng, largest_m=0.5))
        for _ in range(int(rng.integers(0, self.max_occluders + 1))):
            # Touching or nearly touching the object's circle, lower than most objects.
            away = radius + rng.uniform(0.02, 0.2)
            pieces.append(_piece(centre, away, floor, rng, largest_m=0.3))
        rest += [piece for piece in pieces if not _around_an_eye(piece, eyes_m)]
        albedos = rng.uniform(self.min_albedo, self.max_albedo, len(rest) + 1)
        return tuple(
            Body(part, albedo=float(albedo), label=int(part is mesh))
            for part, albedo in zip([mesh, *rest], albedos, strict=True)
        )


def table(
    corners: tuple[np.ndarray, np.ndarray],
    turn: np.ndarray,
    floor: float,
    top: float,
    board: float,
    leg: float,
) -> Mesh:
    """A board on four legs, `corners` its outline [2] before `turn` [2, 2]; lengths in metres."""
    low, high = corners
    parts = [prism(rectangle(low, high) @ turn, top - board, top)]
    # Inside the board's outline and up to its middle: no two faces in one plane.
    near, far = low + leg / 4, high - 1.25 * leg
    for corner in ([x, y] for x in (near[0], far[0]) for y in (near[1], far[1])):
        foot = rectangle(np.array(corner), np.array(corner) + leg)
        parts.append(prism(foot @ turn, floor, top - board / 2))
    return merge(parts)


def rectangle(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[4, 2] corners, counter-clockwise from above."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def ring_of(size: np.ndarray, sides: int, yaw: float) -> np.ndarray:
    """[n, 2] a rectangle's or an ellipse's outline around 0, counter-clockwise."""
    if sides == 4:
        ring = rectangle(-size / 2, size / 2)
    else:
        turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        ring = np.column_stack([np.cos(turn), np.sin(turn)]) * size / 2
    c, s = np.cos(yaw), np.sin(yaw)
    return ring @ np.array([[c, s], [-s, c]])


def _quad(centre: np.ndarray, height: float, half_m: float) -> Mesh:
    corners = rectangle(np.full(2, -half_m), np.full(2, half_m)) + centre[:2]
    vertices = np.column_stack([corners, np.full(4, height - HAIR_M)])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def _around_an_eye(piece: Mesh, eyes_m: np.ndarray) -> bool:
    """Whether a camera would be in the piece or nearer to it than 30 cm."""
    low, high = piece.bounds
    return bool(((eyes_m > low - 0.3) & (eyes_m < high + 0.3)).all(axis=1).any())


def _wall(centre: np.ndarray, away: float, floor: float, angle: float) -> Mesh:
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    along = np.array([-normal[1], normal[0], 0.0])
    foot = np.array([centre[0], centre[1], floor]) + away * normal
    up = np.array([0.0, 0.0, 2.6])
    left, right = foot - 4 * along, foot + 4 * along
    return Mesh(np.array([left, right, right + up, left + up]), np.array([[0, 1, 2], [0, 2, 3]]))


def _piece(
    centre: np.ndarray, away: float, floor: float, rng: np.random.Generator, *, largest_m: float
) -> Mesh:
    """A box or a cylinder on the floor, `away` from the object's axis."""
    angle = rng.uniform(0, 2 * np.pi)
    size = rng.uniform(0.06, largest_m, 3)
    yaw = rng.uniform(0, 2 * np.pi)
    sides = 4 if rng.random() < 0.6 else 20
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) + (np.pi / 4 if sides == 4 else 0)
    ring = np.column_stack([np.cos(turn) * size[0], np.sin(turn) * size[1]]) / 2
    c, s = np.cos(yaw), np.sin(yaw)
    ring = ring @ np.array([[c, s], [-s, c]])
    reach = float(np.linalg.norm(ring, axis=1).max())
    ring += centre[:2] + (away + reach) * np.array([np.cos(angle), np.sin(angle)])
    return prism(ring, floor, floor + float(size[2]) * 1.6)


def prism(ring: np.ndarray, bottom: float, top: float) -> Mesh:
    """Upright, closed, over a convex ring [n, 2] that is counter-clockwise from above."""
    n = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (bottom, top)])
    i = np.arange(n)
    j = (i + 1) % n
    walls = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    fan = np.stack([np.zeros(n - 2, int), i[1:-1], i[2:]], axis=1)
    return Mesh(vertices, np.concatenate([walls, fan[:, ::-1], fan + n]))
