"""What a generated dataset is made of, from its config and the meshes that were read."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.config.compose import choices, composed
from qs3.data.made_of import MadeOf
from qs3.generation.plan import known_classes, mesh_root


def made_of(
    cfg: DictConfig,
    classes: Iterable[str],
    meshes: Iterable[str],
    benchmark: str,
    recipe: str = "",
) -> MadeOf:
    """The line for figures; of a folder of meshes its last name, and not where it lies.

    Args:
        cfg: conf/generate.yaml, composed.
        classes: of the objects.
        meshes: hash of each mesh that could be read.
        benchmark: see `qs3.generation.plan.benchmark`.
        recipe: see `qs3.generation.recipe_fingerprint`.
    """
    objects = "embedded catalogue"
    if cfg.meshes is not None:
        root = mesh_root(cfg).resolve()
        # Below `raw/` PyTorch Geometric and `qs3 download` keep what a dataset is made from.
        objects = f"meshes of {(root.parent if root.name == 'raw' else root).name}"
        objects += " and the embedded catalogue" * cfg.fill_up
    there = set(classes)
    several = "\n".join(sorted(set(meshes) - {""}))
    return MadeOf(
        objects=objects,
        sensor=_sensor(cfg),
        views=cfg.views,
        without=", ".join(name for name in known_classes(cfg) if name not in there),
        benchmark=benchmark,
        meshes=hashlib.sha256(several.encode()).hexdigest()[:12],
        recipe=recipe,
    )


@functools.cache
def _sensor_files() -> dict[str, Any]:
    """What each file of conf/sensor says, in one composition."""
    names = choices("sensor")
    files = composed(None, *(f"+sensor@{name}={name}" for name in names))
    return {name: OmegaConf.to_container(files[name]) for name in names}


def _sensor(cfg: DictConfig) -> str:
    """The sensor's preset (its class where a value was changed), light, errors taken out."""
    if not cfg.sensor:
        holes = " with holes" if cfg.recipe.get("dropout") else ""
        return f"surface samples{holes}"
    words = [_preset(cfg)]
    if kinds := cfg.get("materials"):
        clear = any(kind.get("transmission") for kind in kinds.kinds.values())
        words.append("mixed and clear materials" if clear else "mixed materials")
    if light := cfg.get("light"):
        words += ["light above"] * ("height_m" in light)
        words += ["light between surfaces"] * bool(light.get("bounces"))
    if errors := cfg.get("depth_errors"):
        words += ["no holes"] * (not errors.holes) + ["no mixed pixels"] * (not errors.mixed_pixels)
    return ", ".join(words)


def _preset(cfg: DictConfig) -> str:
    plain = OmegaConf.to_container(cfg.sensor)
    for name, settings in _sensor_files().items():
        if settings == plain:
            return name
    return f"{cfg.sensor._target_.rsplit('.', 1)[-1]} with changed settings"
