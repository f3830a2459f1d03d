"""All bodies of a scene as one mesh, and what a pixel sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body, incidence


@dataclass(frozen=True, eq=False)
class Faces:
    """All bodies as one mesh: one shape means one kernel, however many bodies there are.

    Attributes:
        mesh: all bodies.
        albedo: [F] float32.
        label: [F] uint8.
        body: [F] uint32, index of the body.
    """

    mesh: Mesh
    albedo: np.ndarray
    label: np.ndarray
    body: np.ndarray

    @staticmethod
    def of(bodies: tuple[Body, ...]) -> Faces:
        """Merged, in the order of `bodies`."""
        counts = [len(body.mesh.faces) for body in bodies]
        return Faces(
            merge([body.mesh for body in bodies]),
            np.repeat(np.array([body.albedo for body in bodies], dtype=np.float32), counts),
            np.repeat(np.array([body.label for body in bodies], dtype=np.uint8), counts),
            np.repeat(np.arange(len(bodies), dtype=np.uint32), counts),
        )

    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Three [F, 3] float64 arrays."""
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, i]] for i in range(3))
        return a, b, c

    def normals(self) -> np.ndarray:
        """[F, 3] float64 unit normals, 0 for degenerate faces."""
        a, b, c = self.corners()
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)

    def seen(self, camera: Camera, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Label and cosine of incidence, [h, w], where a camera's pixels see `face` (-1: none)."""
        valid = face >= 0
        face = np.where(valid, face, 0)
        label = np.where(valid, self.label[face], 0).astype(np.uint8)
        normals = (self.normals() @ camera.world_from_camera[:3, :3]).astype(np.float32)
        return label, incidence(normals[face], valid, camera)


def mitsuba_mesh(mi: Any, faces: Faces, properties: Any) -> Any:
    """The mesh in Mitsuba, filled but not yet in a scene."""
    mesh = mi.Mesh("bodies", len(faces.mesh.vertices), len(faces.mesh.faces), props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = faces.mesh.vertices.astype(np.float32).ravel()
    params["faces"] = faces.mesh.faces.astype(np.uint32).ravel()
    params.update()
    return mesh
