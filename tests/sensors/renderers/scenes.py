"""Small scenes that several tests render."""

from __future__ import annotations

import numpy as np

from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Projector, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

RENDERERS = {
    "blender": lambda: BlenderRenderer(),
    "mitsuba": lambda: MitsubaRenderer(),
    "mitsuba_scalar": lambda: MitsubaRenderer(variant="scalar_rgb"),
}


def quad(corners: list[list[float]], albedo: float = 1.0, label: int = 1) -> Body:
    """Two triangles; corners in order."""
    return Body(Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])), albedo, label)


def wall(z_m: float, half_m: float = 5.0, albedo: float = 1.0, label: int = 0) -> Body:
    """A plane that faces a camera at the origin."""
    h = half_m
    return quad([[-h, -h, z_m], [h, -h, z_m], [h, h, z_m], [-h, h, z_m]], albedo, label)


def dots(side: int, seed: int = 0, size: int = 2) -> np.ndarray:
    """A random slide, [side * size] squared, about a fifth of it white."""
    cells = np.random.default_rng(seed).random((side, side)) < 0.2
    return np.kron(cells, np.ones((size, size))).astype(np.float32)


def octahedron(centre_m: tuple[float, float, float], radius_m: float) -> Mesh:
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[i, j, k] for i in (0, 1) for j in (2, 3) for k in (4, 5)]
    return Mesh(corners * radius_m + np.array(centre_m), np.array(faces))


def moved(x_m: float) -> np.ndarray:
    """Pose of a device at (x, 0, 0) that looks along the world's z."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def tilted_pose() -> np.ndarray:
    """Some rotation and position, nothing aligned with anything."""
    angle = 0.3
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    )
    about_z = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = about_z @ about_x
    pose[:3, 3] = 0.1, -0.2, 0.05
    return pose


def busy_scene(ambient: float = 0.2) -> Scene:
    """An octahedron before a wall under a dot slide: edges, shadows, two labels."""
    return Scene(
        (Body(octahedron((0.05, 0.02, 1.0), 0.3), 0.8, 1), wall(1.5, albedo=0.5)),
        Projector(moved(-0.1), dots(32), tan_half_width=0.6, strength=2.0),
        ambient,
    )


def busy_camera(window: Window | None = None) -> Camera:
    return Camera(Intrinsics(96, 80, 90.0, 45.3, 41.8), moved(0.02), window)
