"""A triangle mesh: the one form in which shapes travel through qs3."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.finishes import Finishes
from qs3.meshes.formats.arrays import without_strays
from qs3.meshes.formats.colliders import Colliders

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in metres (or in the file's unit, before normalisation), z up.

    Attributes:
        vertices: [V, 3] float64.
        faces: [F, 3] int32, indices into `vertices`; orientation is not relied upon.
        colliders: invisible nodes of its file or scene that were left out.
        finishes: what its file says its faces are made of; None: nothing, or it was not asked.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colliders: int = 0
    finishes: Finishes | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise MeshError(f"vertices have shape {vertices.shape}, expected [V, 3]")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise MeshError(f"faces have shape {faces.shape}, expected [F, 3] triangles")
        if len(faces) == 0:
            raise MeshError("the mesh has no faces")
        if not np.isfinite(vertices).all():
            bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
            raise MeshError(f"vertex {bad} is not finite")
        if faces.min() < 0 or faces.max() >= len(vertices):
            wrong = int(faces.min() if faces.min() < 0 else faces.max())
            raise MeshError(f"a face refers to vertex {wrong}, but there are {len(vertices)}")
        if self.finishes is not None and len(self.finishes.of_face) != len(faces):
            raise MeshError(f"has materials of {len(self.finishes.of_face)} of {len(faces)} faces")
        vertices, faces = vertices.view(), faces.view()  # the caller's stay as they are
        vertices.flags.writeable = False
        faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @classmethod
    def from_trimesh(
        cls, solid: trimesh.Trimesh | trimesh.Scene, keep_colliders: bool = False
    ) -> Mesh:
        """The triangles of a mesh of trimesh, or of a scene put together, as they stand.

        Vertices that no triangle uses are left out. z is up here and lengths are metres; nothing is
        turned or scaled.

        Args:
            solid: a mesh, whatever its name, or a scene.
            keep_colliders: as `qs3.meshes.io.load_mesh`.

        Raises:
            MeshError: it has no triangles, or is neither of the two.
        """
        import trimesh

        if isinstance(solid, trimesh.Scene):
            colliders = Colliders(skip=not keep_colliders)
            hidden = colliders.left_out_of(solid)
            solids = [part for part in solid.dump() if isinstance(part, trimesh.Trimesh)]
            seen = [part for part in solids if part.metadata["node"] not in hidden]
            parts = [cls.from_trimesh(part) for part in seen if len(part.faces)]
            if colliders.count and not parts:
                raise MeshError(f"has no faces{colliders.exception}")
            return replace(merge(parts), colliders=colliders.count)
        if not isinstance(solid, trimesh.Trimesh):
            raise MeshError(f"expected a trimesh.Trimesh or Scene, got {type(solid).__name__}")
        return cls(*without_strays(np.array(solid.vertices), np.array(solid.faces)))

    def to_trimesh(self) -> trimesh.Trimesh:
        """The same triangles in the same order, unprocessed, in arrays of their own."""
        import trimesh

        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] lowest and highest corner over the vertices that faces use."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @property
    def sha256(self) -> str:
        """Hash of vertices and faces; equal meshes have equal hashes on every machine."""
        digest = hashlib.sha256()
        digest.update(self.vertices.astype("<f8").tobytes())
        digest.update(self.faces.astype("<i4").tobytes())
        return digest.hexdigest()

    def transformed(self, matrix: np.ndarray) -> Mesh:
        """Apply a 4x4 homogeneous matrix to the vertices."""
        return self.at(self.vertices @ matrix[:3, :3].T + matrix[:3, 3])

    def at(self, vertices: np.ndarray) -> Mesh:
        """The same faces and materials with other vertices [V, 3]."""
        return replace(self, vertices=vertices)


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh from several, parts kept apart (no vertex is shared between them)."""
    if not meshes:
        raise MeshError("nothing to merge: the list of meshes is empty")
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    vertices = np.concatenate([m.vertices for m in meshes])
    faces = np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)])
    finishes = Finishes.joined([(m.finishes, len(m.faces)) for m in meshes])
    return Mesh(vertices, faces, finishes=finishes)
