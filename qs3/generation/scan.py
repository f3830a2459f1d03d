"""Meshes from memory through a domain's recipe: what `qs3.generate(mesh, ...)` and figures use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.config.hydra import build
from qs3.errors import DataError
from qs3.generation.kept import Keep
from qs3.generation.plan import planned
from qs3.generation.recipes import Cloud
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Mesh
from qs3.sensors.base import DepthFrame

if TYPE_CHECKING:
    import trimesh
    from omegaconf import DictConfig

    Solid = Mesh | trimesh.Trimesh | trimesh.Scene


@dataclass(frozen=True, eq=False)
class Scan:
    """What a domain's recipe made of one mesh.

    Attributes:
        id: of the object; its bytes depend on it and on the seed.
        points: [P, 3] float32, metres, z up: fused and sampled, as training gets it.
        clean: [P, 3] float32, the twin from the true depth; None where the domain has none.
        views: frames that gave points; 0, and no `frames`, where the domain looks at nothing.
        valid_points: measured points before sampling to P.
        provenance: with provenance=true [P, 5], see `qs3.generation.kept`; else None.
        colliders: invisible nodes of a scene that were left out; 0 with colliders=keep.
    """

    id: str
    points: np.ndarray = field(repr=False)
    clean: np.ndarray | None = field(repr=False)
    views: int
    valid_points: int
    frames: tuple[DepthFrame, ...] = field(default=(), repr=False)
    provenance: np.ndarray | None = field(default=None, repr=False)
    colliders: int = 0


class Scanner:
    """A recipe and, where it looks at meshes, its renderer, in this process."""

    def __init__(self, cfg: DictConfig) -> None:
        plan = planned(cfg)
        self.recipe: Any = plan.recipe
        self.seed = plan.options.seed
        self.renderer = build(cfg.renderer) if self.recipe.needs_renderer else None

    def cloud(self, mesh: Mesh, object_id: str, keep: Keep | None = None) -> Cloud:
        """The bytes that generate.py makes of the mesh under this id and seed."""
        made: Cloud = self.recipe.make(mesh, object_id, self.seed, self.renderer, keep or Keep())
        return made


def scan_meshes(solids: Mapping[str, Solid], overrides: Sequence[str]) -> dict[str, Scan]:
    """Scan meshes from memory, one after the other, in this process; nothing is written.

    Args:
        solids: by id.
        overrides: of generate.py, such as ["domain=specklenet10"].
    """
    from qs3.config.compose import composed

    cfg = composed("generate", *overrides)
    scanner = Scanner(cfg)
    return {name: _scan(scanner, name, solid, cfg) for name, solid in solids.items()}


def _scan(scanner: Scanner, name: str, solid: Any, cfg: DictConfig) -> Scan:
    try:
        mesh = solid
        if not isinstance(solid, Mesh):
            mesh = Mesh.from_trimesh(solid, keep_colliders=cfg.colliders == "keep")
        if cfg.up == "y":
            mesh = mesh.at(mesh.vertices @ Y_UP_TO_Z_UP.T)
        cloud = scanner.cloud(mesh, name, Keep(provenance=cfg.provenance))
    except DataError as error:
        raise type(error)(f"{name}: {error}") from error
    return Scan(
        id=name,
        points=cloud.arrays["points"],
        clean=cloud.arrays.get("points_clean"),
        views=cloud.views,
        valid_points=cloud.valid_points,
        frames=cloud.frames,
        provenance=cloud.arrays.get("provenance"),
        colliders=mesh.colliders,
    )
