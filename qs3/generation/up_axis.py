"""Which axis is up in a folder of meshes whose files do not say: OBJ, PLY, STL and OFF.

Up to twenty meshes of each of the ten classes are held against the shapes of upright objects
(`qs3.data.inspection.gravity`) as the files have them, before any yaw: do they look better with z
up or with y up? The whole collection decides, so that `limit`, `fraction` and `half` change
nothing; each class is also asked alone, and one that clearly differs is named.

How often that is right: docs/how-to/scan-meshes.md.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig

from qs3.classes import CLASSES, known_as
from qs3.data.inspection.gravity import POINTS, UPS, catalogue_model, prefers
from qs3.errors import MeshError
from qs3.generation.objects import mesh_folder
from qs3.geometry.sampling import surface_sample
from qs3.meshes.io import DECLARE_UP
from qs3.meshes.mesh import Mesh
from qs3.meshes.source import MeshItem
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

JUDGED = 20
"""Meshes a class that are looked at, evenly over the sorted list."""

_Z, _Y = UPS.index("+z"), UPS.index("+y")


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the shapes say.

    Attributes:
        scores: by class [n, 6], how well each direction of `gravity.UPS` does as "up".
        silent: files whose format does not say which axis is up; 0 leaves nothing to decide.
    """

    scores: dict[str, Float[np.ndarray, "n 6"]]
    silent: int

    @property
    def axis(self) -> str | None:
        """The direction that is up in the collection, such as "+z"; None where nothing tells."""
        return up_direction(np.concatenate([*self.scores.values()])) if self.scores else None

    @property
    def by_class(self) -> dict[str, str | None]:
        """The same of each class alone."""
        return {cls: up_direction(scores) for cls, scores in self.scores.items()}

    def shares(self) -> str:
        """How many meshes of each class look better with z up than with y up."""
        return ", ".join(
            f"{cls} {int((of[:, _Z] > of[:, _Y]).sum())} of {len(of)}"
            for cls, of in self.scores.items()
        )


def up_direction(scores: Float[np.ndarray, "n 6"]) -> str | None:
    """Which direction of `UPS` most meshes prefer, beyond chance, to +y (or +z); else None.

    One of the other four must beat both.
    """
    best = int(scores.mean(axis=0).argmax())
    if best not in (_Z, _Y) and all(prefers(scores[:, best] - scores[:, to])[1] for to in (_Z, _Y)):
        return UPS[best]
    rather_z = scores[:, _Z] - scores[:, _Y]
    if prefers(rather_z)[1]:
        return "+z"
    return "+y" if prefers(-rather_z)[1] else None


def evidence(items: Sequence[MeshItem]) -> Evidence:
    """Judge the meshes as the files have them; copies count once, damaged files not at all."""
    silent = [item for item in items if item.path and item.path.suffix.lower() not in DECLARE_UP]
    groups: dict[str, list[MeshItem]] = {}
    for item in silent:
        if cls := known_as(item.cls, CLASSES):
            groups.setdefault(cls, []).append(item)
    scores = {}
    for cls, members in groups.items():
        few = np.linspace(0, len(members) - 1, min(len(members), JUDGED)).round().astype(int)
        found = {mesh.sha256: mesh for i in few if (mesh := _read(members[i]))}
        clouds = [cloud for mesh in found.values() if (cloud := _cloud(mesh)) is not None]
        if clouds:
            scores[cls] = catalogue_model().scores(np.stack(clouds), cls)
    return Evidence(scores, len(silent))


def with_up_axis(cfg: DictConfig) -> DictConfig:
    """The config with z or y in the place of `up=auto`; the evidence goes to the log.

    Where the shapes do not tell, it is z with a warning, which is what a file without a word
    about it has always been taken to have.
    """
    if cfg.up != "auto":
        return cfg
    decided = cfg.copy()
    decided.up = "z"
    if cfg.meshes is not None:
        found = evidence(replace(mesh_folder(decided), half="all").items())
        if found.silent:
            decided.up = _said(found)
    return decided


def _said(found: Evidence) -> str:
    """The axis to take, after all has been said about it."""
    judged = sum(map(len, found.scores.values()))
    meshes = counted(judged, "mesh", "meshes")
    shares = f"better with z up than with y up: {found.shares()}" if judged else "no class is known"
    axis = found.axis
    if axis not in ("+z", "+y"):
        why = "do not tell" if axis is None else f"say {axis}, which is neither z nor y"
        log.warning(
            "up=auto: unknown: the shapes of %s %s (%s). z is taken: if it is wrong, all objects "
            "are scanned lying. Say up=z or up=y",
            meshes, why, shares,
        )  # fmt: skip
        taken = "+z"
    else:
        log.info("up=auto: %s is up, by the shapes of %s (%s)", axis[1], meshes, shares)
        taken = axis
    for cls, direction in found.by_class.items():
        if direction not in (None, taken):
            said = direction in ("+z", "+y")  # by `up`; the other four it cannot say
            log.warning(
                "up=auto: the shapes of %s say %s is up, not %s: they are scanned %s. Turn its "
                "files%s",
                cls, direction, taken[1], "upside down" if direction[1] == taken[1] else "lying",
                f", or scan the class alone: classes=[{cls}] up={direction[1]}" * said,
            )  # fmt: skip
    return taken[1]


def _read(item: MeshItem) -> Mesh | None:
    """The mesh; None if it cannot be read."""
    try:
        return item.load()
    except MeshError:
        return None


def _cloud(mesh: Mesh) -> np.ndarray | None:
    """[POINTS, 3] on its surface; None if it has none."""
    try:
        return surface_sample(mesh.vertices, mesh.faces, POINTS, np.random.default_rng(0))
    except MeshError:
        return None
