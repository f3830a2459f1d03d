"""Pinhole cameras and rigid poses.

Conventions, everywhere in qs3: the world is right-handed with z up, in metres; a camera
looks along its +z, x to the right, y down (OpenCV); the centre of the top left pixel is at
(u, v) = (0, 0). `world_from_camera` is the 4x4 matrix that takes camera coordinates to the world.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole without distortion, square pixels.

    Attributes:
        width_px, height_px: size of the whole image.
        focal_px: focal length.
        cx_px, cy_px: principal point; pixel centres are integers, so the middle of an
            image of width W is (W - 1) / 2.
    """

    width_px: int
    height_px: int
    focal_px: float
    cx_px: float
    cy_px: float

    @staticmethod
    def centred(width_px: int, height_px: int, focal_px: float) -> Intrinsics:
        """Principal point in the middle of the image."""
        return Intrinsics(width_px, height_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels: left, top, width, height."""

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices of the window in a whole image."""
        return (
            slice(self.top, self.top + self.height),
            slice(self.left, self.left + self.width),
        )


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics at a pose; `window` limits what is rendered (None: the whole image)."""

    intrinsics: Intrinsics
    world_from_camera: np.ndarray
    window: Window | None = None

    @property
    def rendered(self) -> Window:
        """The pixels that a renderer computes."""
        if self.window is not None:
            return self.window
        return Window(0, 0, self.intrinsics.width_px, self.intrinsics.height_px)

    def moved(self, camera_offset_m: tuple[float, float, float]) -> Camera:
        """The same camera shifted along its own axes (metres)."""
        pose = self.world_from_camera.copy()
        pose[:3, 3] += pose[:3, :3] @ np.asarray(camera_offset_m)
        return replace(self, world_from_camera=pose)


def look_at(eye_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """Pose of a camera at `eye_m` that looks at `target_m`, image upright (world z up).

    Returns:
        [4, 4] float64 world_from_camera.
    """
    eye = np.asarray(eye_m, dtype=np.float64)
    forward = np.asarray(target_m, dtype=np.float64) - eye
    norm = np.linalg.norm(forward)
    assert norm > 0, "a camera cannot look at its own position"
    forward /= norm
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any roll is upright
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = eye
    return pose


def rotation_xyz(angles_rad: np.ndarray) -> np.ndarray:
    """[3, 3] rotation R = Rz Ry Rx from Euler angles (x, y, z)."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles_rad), np.sin(angles_rad)
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


def project(points_m: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World points to pixels.

    Args:
        points_m: [N, 3].

    Returns:
        [N, 2] (u, v) in px, and [N] depth along the optical axis in metres. Points behind
        the camera have a negative depth and no meaningful pixel.
    """
    pose = camera.world_from_camera
    local = (points_m - pose[:3, 3]) @ pose[:3, :3]
    k = camera.intrinsics
    depth = local[:, 2]
    safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    u = k.focal_px * local[:, 0] / safe + k.cx_px
    v = k.focal_px * local[:, 1] / safe + k.cy_px
    return np.stack([u, v], axis=1), depth
