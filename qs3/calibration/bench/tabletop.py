"""A table with boxes and cups, seen by a sensor of ours, in the manner of the real clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.calibration.bench.subject import Subject
from qs3.catalogue.parts import box, cylinder
from qs3.errors import ConfigError
from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body, Renderer


@dataclass(frozen=True)
class Tabletop:
    """Where the camera stands over the table, and what is kept.

    The depth image is moved to the colour camera, as the drivers of Kinect v1 do.

    Attributes:
        height_m: of the camera over the table.
        pitch_deg: how far it looks down. The real clouds: 0.59 m and 35 to 42 degrees.
        near_m, far_m, half_width_m: the part of the table that is kept.
        colour_m: colour camera to the right of the infrared one.
        colour_focal_px: its focal length; the real clouds were made with 525 px.
    """

    height_m: float = 0.59
    pitch_deg: float = 39.0
    near_m: float = 0.25
    far_m: float = 1.25
    half_width_m: float = 0.45
    colour_m: float = 0.025
    colour_focal_px: float = 525.0

    def pose(self) -> np.ndarray:
        """[4, 4] world_from_camera; the table is the plane z = 0."""
        pitch = np.deg2rad(self.pitch_deg)
        eye = np.array([0.0, 0.0, self.height_m])
        return look_at(eye, eye + np.array([np.cos(pitch), 0.0, -np.sin(pitch)]))

    def objects(self, rng: np.random.Generator) -> Mesh:
        """Two to four boxes and cups on the table, the size of those in the clouds."""
        meshes: list[Mesh] = []
        places: list[np.ndarray] = []
        for _ in range(int(rng.integers(2, 5))):
            for _ in range(50):
                at = np.array([rng.uniform(0.5, 0.95), rng.uniform(-0.2, 0.2)])
                if all(np.linalg.norm(at - other) > 0.17 for other in places):
                    break
            places.append(at)
            if rng.random() < 0.6:
                size = rng.uniform((0.06, 0.12, 0.08), (0.14, 0.22, 0.26))
                mesh = box(tuple(size))
            else:
                radius = float(rng.uniform(0.035, 0.08))
                mesh = cylinder(radius, float(rng.uniform(0.08, 0.2)), sides=32)
            turn = np.eye(4)
            angle = rng.uniform(-0.6, 0.6)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            turn[:2, 3] = at
            meshes.append(mesh.transformed(turn))
        return merge(meshes)

    def cropped(self, depth_m: np.ndarray) -> np.ndarray:
        """Only what lies over the table, as in the real clouds: by its measured place."""
        height, width = depth_m.shape
        x = (np.arange(width) - (width - 1) / 2) / self.colour_focal_px
        y = (np.arange(height)[:, None] - (height - 1) / 2) / self.colour_focal_px
        z = depth_m.astype(np.float64)
        local = np.stack([x * z + self.colour_m, y * z, z], axis=-1)
        pose = self.pose()
        world = local @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(invalid="ignore"):
            over = (world[..., 0] > self.near_m) & (world[..., 0] < self.far_m)
            over &= (np.abs(world[..., 1]) < self.half_width_m) & (world[..., 2] > -0.02)
            over &= world[..., 2] < 0.35
        return np.where(over, depth_m, np.float32(np.nan))

    def scan(self, subject: Subject, renderer: Renderer, seed: int) -> np.ndarray:
        """[480, 640] depth image in metres with NaN, in the colour camera; one scene a seed."""
        rng = np.random.default_rng([0x7AB1E, seed])
        near, far, side = self.near_m, self.far_m, self.half_width_m
        corners = np.array([[near, -side, 0], [far, -side, 0], [far, side, 0], [near, side, 0.0]])
        table = Body(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), albedo=0.7, label=1)
        objects = Body(self.objects(rng), albedo=0.6, label=1)
        box_m = np.array([[near, -side, -0.01], [far, side, 0.3]])
        frame = subject.sensor.scan((table, objects), box_m, self.pose(), renderer, rng)
        if frame is None:
            raise ConfigError(f"sensor={subject.name} does not see the table")
        k = subject.intrinsics
        depth = np.full((k.height_px, k.width_px), np.nan, dtype=np.float32)
        rows, cols = frame.depth_m.shape
        depth[frame.top : frame.top + rows, frame.left : frame.left + cols] = frame.depth_m
        return self.cropped(self.registered(depth, k.focal_px))

    def registered(self, depth_m: np.ndarray, focal_px: float) -> np.ndarray:
        """A depth image [h, w] with NaN moved to the colour camera, in whole millimetres.

        `focal_px` is that of the infrared camera, which took it; the nearest surface hides others.
        """
        height, width = depth_m.shape
        rows, cols = np.nonzero(np.isfinite(depth_m))
        z = depth_m[rows, cols].astype(np.float64)
        x = (cols - (width - 1) / 2) / focal_px * z - self.colour_m
        y = (rows - (height - 1) / 2) / focal_px * z
        u = np.rint(x / z * self.colour_focal_px + (width - 1) / 2).astype(int)
        v = np.rint(y / z * self.colour_focal_px + (height - 1) / 2).astype(int)
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        out = np.full((height, width), np.inf)
        np.minimum.at(out, (v[inside], u[inside]), np.rint(z[inside] * 1000) / 1000)
        out[~np.isfinite(out)] = np.nan
        return out.astype(np.float32)
