"""What bodies are made of: materials drawn for the parts of an object, and for all around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.config.checks import check_bool, check_float, check_int
from qs3.errors import ConfigError
from qs3.meshes.finishes import NONE, Finish
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.gloss import Gloss

Surface = tuple[float, Gloss]
"""Albedo and gloss."""

_SAME = 1e-5  # of the largest side: vertices nearer to each other are one
INFRARED_ALBEDO = (0.03, 0.9)
"""From carbon black to the brightest of conf/materials/mixed.yaml: what a guess may be."""
DRAWN = "materials drawn"
"""Begins the note of an object that has not all of its own."""

_ALIKE = 1e-3  # of the largest side: parts whose sides differ by less are alike


@dataclass(frozen=True)
class Kind:
    """One kind of material; each range is [lowest, highest], drawn evenly.

    Attributes:
        weight: how often it is drawn, relative to the others.
        albedo: in the near infrared, where most dyes are clear and carbon black is not.
        roughness, specular, metal, transmission: see `Gloss`.
    """

    weight: float
    albedo: tuple[float, float]
    roughness: tuple[float, float]
    specular: tuple[float, float] = (0.5, 0.5)
    metal: bool = False
    transmission: tuple[float, float] | None = None

    def draw(self, rng: np.random.Generator) -> Surface:
        """Albedo and gloss of one surface."""
        albedo, roughness, specular = (
            float(rng.uniform(*ends)) for ends in (self.albedo, self.roughness, self.specular)
        )
        # Drawn only where it is asked for: kinds without it are drawn as they were.
        clear = 0.0 if self.transmission is None else float(rng.uniform(*self.transmission))
        return albedo, Gloss(roughness, specular, self.metal, clear)


@dataclass(frozen=True)
class MixedMaterials:
    """Every object has a few materials, each of its parts one of them; other bodies have one each.

    A part is what hangs together by its vertices; parts that are alike, as a chair's legs are,
    have the same material. What is drawn depends on the generator and the mesh alone.

    Attributes:
        max_materials: of an object; the number is uniform.
        kinds: by name; a mapping in the place of a `Kind` holds its fields.
    """

    kinds: Mapping[str, Any]
    max_materials: int = 3

    def __post_init__(self) -> None:
        check_int("materials.max_materials", self.max_materials, 1)
        kinds = {name: checked_kind(name, fields) for name, fields in self.kinds.items()}
        object.__setattr__(self, "kinds", kinds)
        if not sum(kind.weight for kind in kinds.values()) > 0:
            raise ConfigError("materials.kinds: no kind has a weight above 0")

    def dress(self, bodies: Sequence[Body], rng: np.random.Generator) -> tuple[Body, ...]:
        """The same shapes with materials; the first body, the object, as one body a material."""
        thing, *rest = bodies
        materials, chosen = self._surfaces(thing.mesh, rng)
        dressed = [
            Body(_faces_of(thing.mesh, chosen == i), albedo, thing.label, gloss)
            for i, (albedo, gloss) in enumerate(materials)
            if (chosen == i).any()
        ]
        for body in rest:
            albedo, gloss = self._draw(rng)
            dressed.append(Body(body.mesh, albedo, body.label, gloss))
        return tuple(dressed)

    def note(self, mesh: Mesh) -> str:
        """What a manifest should say of an object's materials; nothing here."""
        return ""

    def _surfaces(
        self, mesh: Mesh, rng: np.random.Generator
    ) -> tuple[list[Surface], Int[np.ndarray, " f"]]:
        """The object's surfaces, and the index of each face's."""
        materials = [self._draw(rng) for _ in range(int(rng.integers(1, self.max_materials + 1)))]
        parts = parts_of(mesh)
        return materials, rng.integers(0, len(materials), parts.max() + 1)[parts]

    def _draw(self, rng: np.random.Generator) -> Surface:
        kinds: list[Kind] = list(self.kinds.values())
        ends = np.cumsum([kind.weight for kind in kinds])
        place = rng.uniform(0, ends[-1])
        return kinds[int(np.searchsorted(ends, place, side="right"))].draw(rng)


@dataclass(frozen=True)
class OwnMaterials(MixedMaterials):
    """What mesh files say their faces are made of; the rest is drawn as `MixedMaterials` draws it.

    A face of which the file says nothing, or whose colour lies in a picture, has the material that
    it would have without the file's; so has every other body.
    """

    def note(self, mesh: Mesh) -> str:
        """How many faces have drawn materials; empty if none has."""
        found, faces = mesh.finishes, len(mesh.faces)
        if found is None:
            return f"{DRAWN}: the file has none that are read"
        if not found.missing:
            return ""
        pictures = f", {found.pictured} of them in pictures, which are not read"
        return f"{DRAWN} for {found.missing} of {faces} faces" + pictures * bool(found.pictured)

    def _surfaces(
        self, mesh: Mesh, rng: np.random.Generator
    ) -> tuple[list[Surface], Int[np.ndarray, " f"]]:
        drawn, chosen = super()._surfaces(mesh, rng)
        if mesh.finishes is None:
            return drawn, chosen
        own = [surface_of(finish) for finish in mesh.finishes.kinds]
        of_face = mesh.finishes.of_face
        return [*drawn, *own], np.where(of_face == NONE, chosen, len(drawn) + of_face)


def surface_of(finish: Finish) -> Surface:
    """The surface in the near infrared of what a file says of the visible one.

    The colour's brightest channel, clipped to `INFRARED_ALBEDO`: a dye that is dark in one colour
    and bright in another is an organic one, and these are clear in the infrared, where the surface
    is at least as bright as anywhere; grey and black that come from carbon stay as they are.
    """
    albedo = float(np.clip(max(finish.colour), *INFRARED_ALBEDO))
    roughness = float(np.clip(finish.roughness, 0.1, 1))
    return albedo, Gloss(roughness, finish.specular, finish.metal, min(finish.clear, 0.95))


def parts_of(mesh: Mesh) -> Int[np.ndarray, " f"]:
    """For each face the number of its part, from 0; parts that are alike share a number.

    Alike are parts with as many faces and the same three moments of their corners, so that
    neither place nor rotation counts.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    side = float(np.ptp(mesh.bounds, axis=0).max())
    grid = np.rint((mesh.vertices - mesh.bounds[0]) / (_SAME * side)).astype(np.int64)
    _, vertex = np.unique(grid, axis=0, return_inverse=True)
    corners = vertex.ravel()[mesh.faces]
    count = int(corners.max()) + 1
    a, b = corners[:, [0, 1]].ravel(), corners[:, [1, 2]].ravel()
    _, number = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (count, count)), False)
    part = number[corners[:, 0]]
    kinds: dict[tuple[int, ...], int] = {}
    alike = np.zeros(number.max() + 1, dtype=np.int64)
    for i in dict.fromkeys(part.tolist()):
        faces = mesh.faces[part == i]
        points = mesh.vertices[faces.ravel()] / side
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0))
        key = (len(faces), *np.rint(spread / _ALIKE).astype(int).tolist())
        alike[i] = kinds.setdefault(key, len(kinds))
    return alike[part]


def _faces_of(mesh: Mesh, wanted: np.ndarray) -> Mesh:
    used, faces = np.unique(mesh.faces[wanted], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


def checked_kind(name: str, fields: Any) -> Kind:
    """A kind of material; ConfigError names the key that is wrong."""
    place = f"materials.kinds.{name}"
    if isinstance(fields, Kind):
        return fields
    try:
        kind = Kind(**fields)
    except TypeError as error:
        raise ConfigError(f"{place}: {error}") from error
    check_float(f"{place}.weight", kind.weight, ">= 0")
    check_bool(f"{place}.metal", kind.metal)
    ranges = {"albedo": "[0, 1]", "roughness": "[0.1, 1]", "specular": "[0, 1]"}
    if kind.transmission is not None:
        ranges["transmission"] = "[0, 0.95]"
    for key, allowed in ranges.items():
        ends = getattr(kind, key)
        if not isinstance(ends, list | tuple) or len(ends) != 2:
            raise ConfigError(f"{place}.{key} must be [lowest, highest], got {ends!r:.80}")
        for end in ends:
            check_float(f"{place}.{key}", end, allowed)
        if ends[0] > ends[1]:
            raise ConfigError(f"{place}.{key} must be [lowest, highest], got {ends!r}")
    return kind
