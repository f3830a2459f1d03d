"""A triangle mesh, the one form in which shapes travel through qs3, and where it comes from."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.errors import MeshError

if TYPE_CHECKING:
    import trimesh

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in metres (or in the file's unit, before normalisation), z up.

    Attributes:
        vertices: [V, 3] float64.
        faces: [F, 3] int32, indices into `vertices`; orientation is not relied upon.
        colliders: invisible nodes of its file or scene that were left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colliders: int = 0

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        assert vertices.shape[1:] == faces.shape[1:] == (3,)
        if len(faces) == 0:
            raise MeshError("has no faces, or those of colliders alone")
        if not np.isfinite(vertices).all():
            raise MeshError("a vertex is not finite")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshError(f"a face refers to a vertex that is not among the {len(vertices)}")
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

        Vertices that no triangle uses are left out; nothing is turned or scaled. `keep_colliders`
        as in `qs3.meshes.io.load_mesh`.
        """
        import trimesh

        if isinstance(solid, trimesh.Scene):
            hidden, count = (set(), 0) if keep_colliders else _collider_nodes(solid)
            solids = [part for part in solid.dump() if isinstance(part, trimesh.Trimesh)]
            seen = [part for part in solids if part.metadata["node"] not in hidden]
            whole = merge([cls.from_trimesh(part) for part in seen if len(part.faces)])
            return replace(whole, colliders=count)
        return cls(*without_strays(np.array(solid.vertices), np.array(solid.faces)))

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
        """The same faces with other vertices [V, 3]."""
        return replace(self, vertices=vertices)


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh from several, parts kept apart (no vertex is shared between them)."""
    if not meshes:
        raise MeshError("has no faces, or those of colliders alone")
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    vertices = np.concatenate([m.vertices for m in meshes])
    faces = np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)])
    return Mesh(vertices, faces)


def without_strays(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same without vertices that no face uses; the same arrays where there are none.

    They are not seen, but would count for an object's size. Of a damaged file, where one is not
    finite, none is left out: `Mesh` raises.
    """
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if used.all() or not np.isfinite(vertices).all():
        return vertices, faces
    places, flat = np.unique(faces, return_inverse=True)
    return vertices[places], flat.reshape(-1, 3)


@dataclass(frozen=True)
class MeshItem:
    """One object to scan, of the embedded catalogue or of a user's folder.

    Attributes:
        id: unique in its source, e.g. "chair/train/chair_0007"; decides the object's seed.
        load: makes or reads the mesh; raises MeshError with the reason. Picklable.
        origin: what the user would look for: a file name or a family of the catalogue.
        path: the file it is read from; None if it is made.
    """

    id: str
    cls: str
    split: str
    load: Callable[[], Mesh]
    origin: str
    path: Path | None = None


_COLLIDER = re.compile(
    r"^(UCX|UBX|UCP|USP|MCDCX)_"
    r"|(^|[_\-. ])(colliders?|collisions?)([_\-. ]?\d+)*$"
    r"|-(conv)?colonly([_\-. ]?\d+)*$",
    re.IGNORECASE,
)


def is_collider(*names: str | None) -> bool:
    """Whether a node of a scene with one of these names stands for collisions, and is not seen.

    Exporters write `chair_collider` or `chair_collision`, Unreal Engine's static mesh pipeline
    UCX_, UBX_, UCP_, USP_ or MCDCX_ before the name, and Godot `-colonly` or `-convcolonly` behind
    it (its `-col` keeps the mesh visible).
    """
    return any(_COLLIDER.search(str(name)) for name in names if name)


def _collider_nodes(scene: trimesh.Scene) -> tuple[set[Hashable], int]:
    """Colliders with all below them, or only a node's geometry if that has the name; how many."""
    forest, hidden, count = scene.graph.transforms, set(), 0
    waiting = [node for node in forest.nodes if node not in forest.parents]
    while waiting:
        node = waiting.pop()
        if is_collider(str(node)):
            hidden |= forest.successors(node)
            count += 1
            continue
        if is_collider(forest.node_data[node].get("geometry")):
            hidden.add(node)
            count += 1
        waiting += forest.children.get(node, ())
    return hidden, count
