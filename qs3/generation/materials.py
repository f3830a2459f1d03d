"""What bodies are made of, and the light of the place where they are scanned."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from annotated_types import Interval
from jaxtyping import Int

from qs3.meshes.mesh import Mesh
from qs3.sensors.base import Lighting
from qs3.sensors.renderers.base import AreaLight, Body
from qs3.sensors.renderers.gloss import Gloss
from qs3.utils.settings import Count, NotNegative, Positive, Share, settings

Surface = tuple[float, Gloss]
"""Albedo and gloss."""

_SAME = 1e-5  # of the largest side: vertices nearer to each other are one
_ALIKE = 1e-3  # of the largest side: parts whose sides differ by less are alike

Rough = Annotated[float, Interval(ge=0.1, le=1)]


@settings
class Kind:
    """One kind of material, see `Gloss`; each range is [lowest, highest], drawn evenly."""

    weight: NotNegative  # how often it is drawn, relative to the others
    albedo: tuple[Share, Share]  # in the near infrared: most dyes are clear, carbon black is not
    roughness: tuple[Rough, Rough]
    specular: tuple[Share, Share] = (0.5, 0.5)
    metal: bool = False

    def draw(self, rng: np.random.Generator) -> Surface:
        """Albedo and gloss of one surface."""
        albedo, roughness, specular = (
            float(rng.uniform(*ends)) for ends in (self.albedo, self.roughness, self.specular)
        )
        return albedo, Gloss(roughness, specular, self.metal)


@settings
class MixedMaterials:
    """Every object has a few materials, each of its parts one of them; other bodies have one each.

    A part is what hangs together by its vertices; parts that are alike, as a chair's legs are,
    have the same material. What is drawn depends on the generator and the mesh alone.
    """

    kinds: Mapping[str, Kind]
    max_materials: Count = 3  # of an object; the number is uniform

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

    def _surfaces(
        self, mesh: Mesh, rng: np.random.Generator
    ) -> tuple[list[Surface], Int[np.ndarray, " f"]]:
        """The object's surfaces, and the index of each face's."""
        materials = [self._draw(rng) for _ in range(int(rng.integers(1, self.max_materials + 1)))]
        parts = parts_of(mesh)
        return materials, rng.integers(0, len(materials), parts.max() + 1)[parts]

    def _draw(self, rng: np.random.Generator) -> Surface:
        kinds = list(self.kinds.values())
        ends = np.cumsum([kind.weight for kind in kinds])
        place = rng.uniform(0, ends[-1])
        return kinds[int(np.searchsorted(ends, place, side="right"))].draw(rng)


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


@settings
class LightAbove:
    """The paper's light (section 3.1): one area light on top of the object, a level square.

    Its strength is the radiance of a white level surface there, in the units of `sensor.ambient`:
    with sensor=speckle_stereo a lit dot on white has 1 at 4 m.
    """

    height_m: Positive = 1.5  # over the object's highest point
    side_m: Positive = 24.34  # of the square, whose middle is over the object's
    strength: NotNegative = 0.15
    ambient: NotNegative | None = None  # of light from all sides; null: `sensor.ambient`

    def over(self, box_m: np.ndarray) -> Lighting:
        """Over an object with box [2, 3]."""
        middle = box_m.mean(axis=0)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])  # it looks down
        pose[:3, 3] = middle[0], middle[1], box_m[1, 2] + self.height_m
        # The share of what a point sees above itself that the square fills, by cosines.
        slope = self.side_m / (2 * self.height_m)
        part = slope / math.hypot(1, slope)
        seen = 4 / math.pi * part * math.atan(part)
        area = AreaLight(pose, self.side_m, self.strength / seen)
        return Lighting(area, self.ambient)
