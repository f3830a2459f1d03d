"""Meshes from memory through a domain's recipe: what `qs3.generate(mesh, ...)` and figures use."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError
from qs3.generation.checks import check, check_recipe
from qs3.generation.materials import MixedMaterials
from qs3.generation.materials_file import with_materials
from qs3.generation.mesh_sizes import warn_of_lost
from qs3.generation.provenance import Keep
from qs3.generation.recipes import Cloud
from qs3.meshes.formats.arrays import Y_UP_TO_Z_UP
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthFrame
from qs3.utils.plural import counted

if TYPE_CHECKING:
    import trimesh
    from omegaconf import DictConfig

    Solid = Mesh | trimesh.Trimesh | trimesh.Scene

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scan:
    """What a domain's recipe made of one mesh.

    Attributes:
        id: of the object; its bytes depend on it and on the seed.
        points: [P, 3] float32, metres, z up: fused and sampled, as training gets it.
        clean: [P, 3] float32, the twin from the true depth; None where the domain has none.
        views: frames that gave points; 0 where the domain looks at nothing.
        valid_points: measured points before sampling to P.
        frames: the depth frames of all views; empty where the domain looks at nothing.
        provenance: with provenance=true [P, 5], see `qs3.generation.provenance`; else None.
        colliders: invisible nodes of a scene that were left out; 0 with colliders=keep.
    """

    id: str
    points: np.ndarray
    clean: np.ndarray | None
    views: int
    valid_points: int
    frames: tuple[DepthFrame, ...] = ()
    provenance: np.ndarray | None = None
    colliders: int = 0

    def __repr__(self) -> str:
        """In a line, without its arrays."""
        seen = f", {counted(self.views, 'view')}" if self.views else ""
        twin = "" if self.clean is None else ", clean twin"
        return (
            f"Scan({self.id!r}, {counted(len(self.points), 'point')} of {self.valid_points} "
            f"measured{seen}{twin})"
        )


class Scanner:
    """A recipe and, where it looks at meshes, its renderer, in this process.

    Raises:
        ConfigError: a setting is wrong.
        RenderError: the renderer cannot be used here.
    """

    def __init__(self, cfg: DictConfig) -> None:
        check(cfg)
        self.recipe: Any = build(cfg.recipe)  # a Recipe, with the fields of its class
        check_recipe(self.recipe, cfg)
        self.seed: int = cfg.seed
        self.renderer = build(cfg.renderer) if self.recipe.needs_renderer else None

    def cloud(self, mesh: Mesh, object_id: str, keep: Keep | None = None) -> Cloud:
        """The bytes that generate.py makes of the mesh under this id and seed."""
        return self.recipe.make(mesh, object_id, self.seed, self.renderer, keep or Keep())


def composed_recipe(overrides: Sequence[str]) -> DictConfig:
    """The config of generate.py with these words.

    Raises:
        ConfigError: a word is wrong, or the domain is published and not generated.
    """
    from qs3.config.compose import composed

    words = with_materials(overrides)
    try:
        return composed("generate", *words)
    except ConfigError as error:
        missing = str(getattr(error.__cause__, "missing_cfg_file", ""))
        if not missing.startswith("synthesis/"):
            raise
        raise ConfigError(
            f"domain={missing.partition('/')[2]} is published, not generated: nothing is known of "
            "how its objects were scanned; choose another, such as domain=specklenet10"
        ) from error


def scan_meshes(solids: Mapping[str, Solid], overrides: Sequence[str]) -> dict[str, Scan]:
    """Scan meshes from memory, one after the other, in this process; nothing is written.

    Args:
        solids: by id.
        overrides: of generate.py, such as ["domain=specklenet10", "renderer=mitsuba"].

    Raises:
        ConfigError: a setting is wrong, or says something about files only.
        MeshError, DataError, RenderError: a mesh cannot be scanned; the message names it.
    """
    cfg = composed_recipe(overrides)
    for key, nothing in (("meshes", None), ("keep_views", False), ("twins", [])):
        if cfg[key] != nothing:
            raise ConfigError(
                f"{key}= is for files: a scan of meshes from memory has no use for it"
            )
    for key, everything in (("limit", None), ("fraction", 1.0), ("splits", None)):
        if cfg[key] != everything:
            raise ConfigError(
                f"{key}= chooses among the objects of a dataset; meshes from memory are all "
                "scanned: leave it out, and give those that you want"
            )
    if cfg.scans != 1:
        raise ConfigError(
            "scans= is for datasets; a mesh from memory is scanned once under each id: give it "
            'under several, {"a": mesh, "a~1": mesh}'
        )
    scanner = Scanner(cfg)
    return {name: _scan(scanner, name, solid, cfg) for name, solid in solids.items()}


def _scan(scanner: Scanner, name: str, solid: Any, cfg: DictConfig) -> Scan:
    keep = Keep(provenance=cfg.provenance)
    try:
        if isinstance(solid, Mesh):
            mesh = solid
        else:
            mesh = Mesh.from_trimesh(solid, keep_colliders=cfg.colliders == "keep")
        if cfg.up == "y":
            mesh = mesh.at(mesh.vertices @ Y_UP_TO_Z_UP.T)
        warn_of_lost(getattr(scanner.recipe, "placing", None), [mesh])
        cloud = scanner.cloud(mesh, name, keep)
        materials: MixedMaterials | None = getattr(scanner.recipe, "materials", None)
        if materials is not None and (note := materials.note(mesh)):
            log.warning("%s: %s", name, note)
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
