"""What generate.py is about to do, written down: what decides the bytes of a dataset."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.config.hydra import build
from qs3.errors import MeshError
from qs3.generation.objects import catalogue_seed, mesh_items, own_materials
from qs3.generation.provenance import Keep
from qs3.generation.released.poses import read_poses
from qs3.generation.twins import TWINS
from qs3.meshes.formats.gltf import buffer_files
from qs3.meshes.formats.mtl import libraries
from qs3.meshes.source import MeshItem
from qs3.store.parts import VIEWS as VIEWS_FOLDER
from qs3.utils.files import sha256_file
from qs3.utils.version import VERSION

_NOT_DECISIVE = ("threads",)  # of a renderer: never changes a byte
_PREVIEWS = 2  # objects a class whose first view is kept for the contact sheet
# Keys of a config that say where things lie, or that never change a byte.
_UNSTORED = ("paths", "workers", "engine", "force", "strict")


def keep(cfg: DictConfig, items: Sequence[MeshItem], folder: Path) -> Keep:
    """What is wanted besides the clouds: provenance, views, and previews of some objects."""
    seen: Counter[str] = Counter()
    previews = []
    for item in items:
        if seen[item.cls] < _PREVIEWS:
            previews.append(item.id)
        seen[item.cls] += 1
    return Keep(
        provenance=cfg.provenance,
        views=folder / VIEWS_FOLDER if cfg.keep_views else None,
        twins=frozenset(cfg.twins),
        previews=frozenset(previews),
    )


def describe(cfg: DictConfig, items: list[MeshItem], renderer: dict[str, str]) -> dict[str, Any]:
    """All that decides the bytes of a dataset: what a resume is compared with.

    A folder of meshes is described by the content of its files, not by where it lies.
    """
    return {
        "kept": [
            *(key for key in ("provenance", "keep_views") if cfg[key]),
            *(f"twins={name}" for name in TWINS if name in cfg.twins),
        ],
        "settings": settings(cfg),
        "objects": [_name_and_content(item, own_materials(cfg)) for item in items],
        "versions": {
            **renderer,
            "qs3": VERSION,
            "numpy": version("numpy"),
            "opencv": version("opencv-python-headless"),
            "fpsample": version("fpsample"),
            "machine": platform.machine(),
        },
    }


def settings(cfg: DictConfig) -> dict[str, Any]:
    """The settings that decide the bytes of an object, as plain values."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    chosen = {
        "domain": build(cfg.domain).folder.name,
        "seed": plain["seed"],
        "recipe": _with_content_of_poses(plain["recipe"]),
        "meshes": _kind_of_meshes(plain),
        "colliders": plain["colliders"],
        "up": "y" if plain["up"] == "y" else "z",
    }
    if plain["renderer"]:
        chosen["renderer"] = {k: v for k, v in plain["renderer"].items() if k not in _NOT_DECISIVE}
    return chosen


def _kind_of_meshes(plain: dict[str, Any]) -> Any:
    if plain["fill_up"]:
        return {"folder, filled up by": {**plain["catalogue"], "seed": catalogue_seed(plain)}}
    return "folder" if plain["meshes"] else plain["catalogue"]


def _with_content_of_poses(recipe: dict[str, Any]) -> dict[str, Any]:
    """The recipe with a hash of the poses in place of their path; without them, with nothing."""
    poses = dict(recipe.get("poses") or {})
    path = poses.pop("path", None)
    rest = {key: value for key, value in recipe.items() if key != "poses"}
    if path is None:
        return rest
    return {**rest, "poses": {**poses, "sha256": read_poses(Path(path).expanduser()).sha256}}


def stored_config(cfg: DictConfig) -> dict[str, Any]:
    """The composed config as meta.yaml holds it: all but places and what changes no byte."""
    plain: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in _UNSTORED:
        plain.pop(key, None)
    for key in _NOT_DECISIVE:
        plain["renderer"].pop(key, None)
    if plain["meshes"] is not None:
        plain["meshes"] = "folder"
    if plain.get("poses") is not None:
        plain["poses"] = "file"
    return plain


def benchmark(cfg: DictConfig, recipe: dict[str, Any]) -> str:
    """Whether this is the benchmark that a domain's version names, a split of it, or like it.

    Returns:
        "kinectsim10 v2"; "kinectsim10 v2, train" for its train part alone, whose objects are the
        same; "like kinectsim10 v2, but not it" where settings or objects differ; empty for
        domains without a version.
    """
    stated = cfg.get("benchmark")
    if stated is None:
        return ""
    name = f"{cfg.domain.name} v{stated.version}"
    if plan_hash(recipe) == stated.plan_sha256:
        return name
    if cfg.splits and cfg.meshes is None:  # other meshes than the catalogue's are not it anyway
        whole = mesh_items(OmegaConf.merge(cfg, {"splits": None}))  # type: ignore[arg-type]
        part = [_name_and_content(item, False) for item in whole if item.split in cfg.splits]
        full = {**recipe, "objects": [_name_and_content(item, False) for item in whole]}
        if recipe["objects"] == part and plan_hash(full) == stated.plan_sha256:
            return f"{name}, {' and '.join(cfg.splits)}"
    return f"like {name}, but not it (other settings or objects)"


def stated_hash(cfg: DictConfig, recipe: dict[str, Any]) -> str:
    """Content hash that the benchmark should have with this renderer variant; empty if unknown."""
    stated = cfg.get("benchmark")
    if stated is None or plan_hash(recipe) != stated.plan_sha256:
        return ""
    if "width" in recipe["versions"]:  # of Mitsuba's kernels: not the one that was stated
        return ""
    return str(stated.content_sha256.get(recipe["versions"].get("variant"), ""))


def plan_hash(recipe: dict[str, Any]) -> str:
    """Hash of settings and objects, without versions and without the renderer's variant."""
    plan = {"settings": dict(recipe["settings"]), "objects": recipe["objects"]}
    renderer = dict(plan["settings"].get("renderer", {}))
    renderer.pop("variant", None)
    plan["settings"]["renderer"] = renderer
    return hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()


def _name_and_content(item: MeshItem, with_materials: bool) -> str:
    if item.path is None:
        return f"{item.id} {item.origin}"
    files = [item.path, *buffer_files(item.path)]
    if with_materials:
        with contextlib.suppress(MeshError):  # of one object, which will fail by it
            files += libraries(item.path)
    return f"{item.id} {item.origin} {' '.join(sha256_file(path)[:16] for path in files)}"
