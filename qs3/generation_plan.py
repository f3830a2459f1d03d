"""What generate.py is about to do: settings checked, objects listed, everything written down."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

import qs3
from qs3.classes import CLASSES
from qs3.errors import ConfigError
from qs3.files import sha256_file
from qs3.hydra_glue import build
from qs3.meshes.folder import MeshFolder
from qs3.meshes.source import MeshItem
from qs3.settings import whole

_WHOLE = {"seed": 0, "workers": 0, "limit": 1, "scans": 1, "views": 0}
_NOT_DECISIVE = ("threads",)  # of a renderer: never changes a byte


def check(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that no later step would explain as well."""
    for key, least in _WHOLE.items():
        if cfg[key] is not None or key != "limit":
            whole(key, cfg[key], least)
    if not isinstance(cfg.fraction, int | float) or not 0 < cfg.fraction <= 1:
        raise ConfigError(f"fraction must be in (0, 1], got {cfg.fraction!r}")
    if cfg.classes is not None:
        if not isinstance(cfg.classes, ListConfig):
            raise ConfigError(f"classes is a list: classes=[{cfg.classes}]")
        if unknown := sorted(set(cfg.classes) - set(CLASSES)):
            raise ConfigError(f"classes: {unknown} are not among the known {', '.join(CLASSES)}")
    if cfg.meshes is None and cfg.half != "all":
        raise ConfigError("half= divides a folder of meshes: give one with meshes=PATH")


def check_recipe(recipe: Any, cfg: DictConfig) -> None:
    """Raise ConfigError if sensor or renderer are missing where the recipe needs them."""
    if not recipe.needs_renderer:
        return
    for key, part in (("sensor", recipe.sensor), ("renderer", cfg.renderer)):
        if not part:
            raise ConfigError(
                f"domain {cfg.domain.name} looks at meshes: {key}=none does not do, choose another"
            )


def mesh_items(cfg: DictConfig) -> list[MeshItem]:
    """The objects to scan, from the user's folder or the embedded catalogue."""
    classes = tuple(cfg.classes) if cfg.classes else None
    if cfg.meshes is None:
        items = build(cfg.catalogue, classes=classes or CLASSES).items()
    else:
        items = MeshFolder(
            path=mesh_root(cfg),
            classes=classes,
            test_fraction=cfg.test_fraction,
            half=cfg.half,
        ).items()
    kept = _first_of_each(items, cfg.limit, cfg.fraction)
    return [_scan_of(item, scan) for item in kept for scan in range(cfg.scans)]


def mesh_root(cfg: DictConfig) -> Path:
    """The user's folder of meshes."""
    return Path(cfg.meshes).expanduser()


def describe(cfg: DictConfig, items: list[MeshItem], renderer: dict[str, str]) -> dict[str, Any]:
    """All that decides the bytes of a dataset: what a resume is compared with.

    A folder of meshes is described by the content of its files, not by where it lies.
    """
    return {
        "settings": settings(cfg),
        "objects": [_name_and_content(item) for item in items],
        "versions": {
            **renderer,
            "qs3": qs3.__version__,
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
        "domain": Path(plain["domain"]["path"]).name,
        "seed": plain["seed"],
        "recipe": plain["recipe"],
        "meshes": "folder" if plain["meshes"] else plain["catalogue"],
    }
    if plain["renderer"]:
        chosen["renderer"] = {k: v for k, v in plain["renderer"].items() if k not in _NOT_DECISIVE}
    return chosen


def benchmark(cfg: DictConfig, recipe: dict[str, Any]) -> str:
    """Whether this is the benchmark that a domain's version names, or something like it.

    Returns:
        "kinectsim10 v1", or "like kinectsim10 v1, but not it" where settings or objects
        differ; empty for domains without a version.
    """
    stated = cfg.get("benchmark")
    if stated is None:
        return ""
    name = f"{cfg.domain.name} v{stated.version}"
    same = plan_hash(recipe) == stated.plan_sha256
    return name if same else f"like {name}, but not it (other settings or objects)"


def stated_hash(cfg: DictConfig, recipe: dict[str, Any]) -> str:
    """Content hash that the benchmark should have with this renderer variant; empty if unknown."""
    stated = cfg.get("benchmark")
    if stated is None or plan_hash(recipe) != stated.plan_sha256:
        return ""
    return str(stated.content_sha256.get(recipe["versions"].get("variant"), ""))


def plan_hash(recipe: dict[str, Any]) -> str:
    """Hash of settings and objects, without versions and without the renderer's variant."""
    plan = {"settings": dict(recipe["settings"]), "objects": recipe["objects"]}
    renderer = dict(plan["settings"].get("renderer", {}))
    renderer.pop("variant", None)
    plan["settings"]["renderer"] = renderer
    return hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()


def _name_and_content(item: MeshItem) -> str:
    content = "" if item.path is None else f" {sha256_file(item.path)[:16]}"
    return f"{item.id} {item.origin}{content}"


def _scan_of(item: MeshItem, scan: int) -> MeshItem:
    """The same mesh under another id, so with other randomness; scan 0 keeps its id."""
    return item if scan == 0 else replace(item, id=f"{item.id}~{scan}")


def _first_of_each(items: Sequence[MeshItem], limit: int | None, fraction: float) -> list[MeshItem]:
    totals = Counter((item.cls, item.split) for item in items)
    seen: Counter[tuple[str, str]] = Counter()
    kept = []
    for item in items:
        group = (item.cls, item.split)
        wanted = math.ceil(fraction * totals[group] - 1e-9)
        if seen[group] < min(wanted, limit or wanted):
            kept.append(item)
        seen[group] += 1
    return kept
