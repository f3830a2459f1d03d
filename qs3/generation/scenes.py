"""What stands around the object: nothing (the paper), or a floor with clutter and occluders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body


class Surroundings(Protocol):
    """What stands around the object."""

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object first (label 1), then the rest (label 0)."""
        ...


@dataclass(frozen=True)
class Alone:
    """The object floats in the dark, as in the paper."""

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object, with the default albedo."""
        return (Body(mesh, albedo=0.8, label=1),)


@dataclass(frozen=True)
class Room:
    """The object stands on a floor, maybe before a wall, among boxes and cylinders.

    Attributes:
        wall: probability of a wall behind the object.
        max_clutter: up to so many pieces stand around the object ...
        max_occluders: ... and so many close to it, where they hide a part of it.
        clutter_m, occluder_m: the largest side of either along the floor; pieces are up to 1.6
            times as high.
        max_between: up to so many pieces stand between the first camera and the object, some way
            before it, as a table stands before a chair; as large as `between_m` along the floor
            and as high as `between_height_m`.
        min_albedo, max_albedo: of every body, drawn for each.
    """

    wall: float = 0.5
    max_clutter: int = 5
    max_occluders: int = 2
    clutter_m: float = 0.5
    occluder_m: float = 0.3
    max_between: int = 0
    between_m: float = 1.0
    between_height_m: float = 0.8
    min_albedo: float = 0.25
    max_albedo: float = 0.9

    def bodies(self, mesh: Mesh, eyes_m: np.ndarray, rng: np.random.Generator) -> tuple[Body, ...]:
        """The object, the floor it stands on, and the rest.

        Args:
            mesh: the object, placed.
            eyes_m: [V, 3] where the cameras will be; nothing is put there, and no wall
                between them and the object.
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
            pieces.append(_piece(centre, away, floor, rng, largest_m=self.clutter_m))
        for _ in range(int(rng.integers(0, self.max_occluders + 1))):
            # Touching or nearly touching the object's circle, lower than most objects.
            away = radius + rng.uniform(0.02, 0.2)
            pieces.append(_piece(centre, away, floor, rng, largest_m=self.occluder_m))
        if self.max_between:
            for _ in range(int(rng.integers(0, self.max_between + 1))):
                pieces.append(self._between(centre, radius, floor, eyes_m[0], rng))
        rest += [piece for piece in pieces if not _around_an_eye(piece, eyes_m)]
        albedos = rng.uniform(self.min_albedo, self.max_albedo, len(rest) + 1)
        return tuple(
            Body(part, albedo=float(albedo), label=int(part is mesh))
            for part, albedo in zip([mesh, *rest], albedos, strict=True)
        )

    def _between(
        self,
        centre: np.ndarray,
        radius: float,
        floor: float,
        eye_m: np.ndarray,
        rng: np.random.Generator,
    ) -> Mesh:
        """A box on the floor, beside or on the line from the object to a camera."""
        ahead = eye_m[:2] - centre[:2]
        distance = float(np.hypot(*ahead))
        along = ahead / max(distance, 1e-9)
        size = rng.uniform(
            [0.15, 0.15, 0.2], [self.between_m, self.between_m, self.between_height_m]
        )
        nearest = radius + size[:2].max() / 2
        away = nearest + rng.uniform(0.05, 0.5) * max(distance - nearest, 0.1)
        aside = rng.normal(0, radius + 0.2) * np.array([-along[1], along[0]])
        yaw = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(yaw), np.sin(yaw)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * size[:2]
        ring = corners @ np.array([[c, s], [-s, c]]) + centre[:2] + away * along + aside
        return _prism(ring, floor, floor + float(size[2]))


def _quad(centre: np.ndarray, height: float, half_m: float) -> Mesh:
    x, y = centre[:2]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half_m + [x, y]
    # A hair below the object, so that its own bottom face is not in the floor's plane.
    vertices = np.column_stack([corners, np.full(4, height - 1e-4)])
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
    return _prism(ring, floor, floor + float(size[2]) * 1.6)


def _prism(ring: np.ndarray, bottom: float, top: float) -> Mesh:
    n = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (bottom, top)])
    i = np.arange(n)
    j = (i + 1) % n
    walls = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    fan = np.stack([np.zeros(n - 2, int), i[1:-1], i[2:]], axis=1)
    return Mesh(vertices, np.concatenate([walls, fan[:, ::-1], fan + n]))
