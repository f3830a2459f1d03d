"""Settings of generate.py, checked before anything is done."""

from __future__ import annotations

import difflib
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from qs3.config.checks import check_bool, check_choice, check_float, check_int, check_keys
from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.generation.camera_poses import Drift
from qs3.generation.objects import known_classes
from qs3.generation.room_scans import RoomScan
from qs3.generation.twins import TWINS, VIEWS
from qs3.meshes.folder import SPLITS

KEYS = (
    *("seed", "meshes", "fill_up", "poses", "half", "test_fraction", "up", "colliders", "classes"),
    *("splits", "limit", "fraction", "scans", "provenance", "keep_views", "twins", "workers"),
    *("force", "strict", "paths", "domain", "catalogue", "renderer", "scene"),
    *("tracking", "crop", "views", "recipe", "sensor", "counts", "released", "engine"),
    *("materials", "light", "depth_errors", "benchmark", "cutting"),
)
"""The keys at the top of conf/generate.yaml and of all that it composes."""

_WHOLE = {"seed": 0, "workers": 0, "limit": 1, "scans": 1, "views": 0}
COLLIDERS = ("skip", "keep")
UPS = ("z", "y")
_SWITCHES = ("provenance", "keep_views", "force", "strict", "fill_up")
# Groups that say nothing to a domain that looks at nothing, by the empty choice that it has.
_OF_LOOKING = ("scene", "tracking", "crop")
_OF_LIGHT = ("materials", "light")
_OF_DEPTH = (*_OF_LIGHT, "depth_errors")


def check(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that no later step would explain as well."""
    text = OmegaConf.to_yaml(cfg, resolve=False)
    check_keys("", [key for key in map(str, cfg) if f"${{{key}" not in text], KEYS)
    for key, least in _WHOLE.items():
        if cfg[key] is not None or key != "limit":
            check_int(key, cfg[key], least)
    check_float("fraction", cfg.fraction, "(0, 1]")
    if cfg.classes is not None:
        if not isinstance(cfg.classes, ListConfig):
            raise ConfigError(f"classes is a list: classes=[{cfg.classes}]")
        if not cfg.classes:
            raise ConfigError("classes=[] leaves nothing to scan: name some, classes=[chair,table]")
        known = known_classes(cfg)
        if unknown := sorted(set(cfg.classes) - set(known)):
            near = difflib.get_close_matches(str(unknown[0]), known, n=1)
            hint = (
                f"did you mean {near[0]}?"
                if near
                else "others are given as '+domain.classes=[...]', with domain.path= for their "
                "dataset"
            )
            raise ConfigError(
                f"classes: {unknown} are not among the known {', '.join(known)}; {hint}"
            )
    if cfg.splits is not None:
        if not (isinstance(cfg.splits, ListConfig) and cfg.splits):
            raise ConfigError(f"splits is a list: splits=[train], got {cfg.splits}")
        if unknown := sorted(set(map(str, cfg.splits)) - set(SPLITS)):
            raise ConfigError(f"splits: {unknown} are not among {', '.join(SPLITS)}")
    if not isinstance(cfg.twins, ListConfig) or not {*cfg.twins} <= {*TWINS}:
        raise ConfigError(f"twins is a list of {', '.join(TWINS)}: twins=[whole], got {cfg.twins}")
    for key in _SWITCHES:
        check_bool(key, cfg[key])
    check_choice("colliders", cfg.colliders, COLLIDERS)
    check_choice("up", cfg.up, UPS)
    if cfg.paths.data_dir is None or not str(cfg.paths.data_dir).strip():
        raise ConfigError(f"paths.data_dir must name a folder, got {cfg.paths.data_dir!r}")
    if cfg.meshes is not None and not str(cfg.meshes).strip():
        raise ConfigError("meshes= must name a folder; leave it out for the embedded catalogue")
    if cfg.meshes is None and cfg.half != "all":
        raise ConfigError("half= divides a folder of meshes: give one with meshes=PATH")
    if cfg.meshes is None and cfg.fill_up:
        raise ConfigError(
            "fill_up= adds the catalogue's objects to meshes of yours: give them with meshes=PATH"
        )
    for key in ("released", "poses"):
        if cfg.get(key) and "poses" not in cfg.recipe:
            raise ConfigError(
                f"{key}= is for domain=specklenet10, and where it fits for blensor10, as the "
                f"authors made them; leave it out for domain={cfg.domain.name}"
            )

    looks = cfg.sensor and "sensor" in cfg.recipe
    for key in ("sensor", *_OF_DEPTH):
        # Before the recipe is built: one that looks at nothing does not take them.
        if cfg.get(key) and not looks:
            raise ConfigError(
                f"domain {cfg.domain.name} looks at nothing, so {key}= says nothing to it: leave "
                "it out"
            )
    if cfg.get("depth_errors") and cfg.recipe._target_.endswith("RoomScan"):
        raise ConfigError(
            "depth_errors= changes which pictures of a room pass its rules, so that objects would "
            "be seen from elsewhere: leave it out, or take a source without a room, such as "
            "domain=specklenet10_kinect"
        )


def check_recipe(recipe: Any, cfg: DictConfig) -> None:
    """Raise ConfigError if sensor or renderer are missing where the recipe needs them.

    And if something is asked for that a domain without views cannot give.
    """
    if not recipe.needs_renderer:
        for key in (*_OF_LOOKING, "views", "provenance", "keep_views", "twins"):
            if cfg.get(key):
                raise ConfigError(
                    f"domain {cfg.domain.name} looks at nothing, so {key}= says nothing to it: "
                    "leave it out"
                )
        return
    parts = {"sensor": recipe.sensor, "renderer": cfg.renderer}
    for key, part in (*parts.items(), *((key, cfg[key]) for key in _OF_LOOKING if key in cfg)):
        if not part:
            raise ConfigError(
                f"domain {cfg.domain.name} looks at meshes: {key}=none does not do, choose another"
            )
    if isinstance(recipe, RoomScan) and cfg.get("tracking") and build(cfg.tracking) != Drift():
        raise ConfigError(
            "a scan of a room is one view, whose pose is known, so tracking= says nothing to it: "
            "leave it out, or take a domain of several views such as kinectsim10"
        )
    if VIEWS in cfg.twins and getattr(recipe.views, "count", recipe.views) == 1:
        raise ConfigError(
            "twins=[views]: with one view it is the cloud itself; leave it out, or take a domain "
            "of several such as specklenet10"
        )
    for key in _OF_LIGHT:
        if cfg.get(key) and not recipe.sensor.sees_light:
            raise ConfigError(
                f"this sensor adds noise to the true depth and sees no light, so {key}= says "
                "nothing to it: leave it out, or take a sensor such as sensor=speckle_stereo"
            )
    if (cfg.get("light") or {}).get("bounces") and not recipe.sensor.sees_bounces:
        raise ConfigError(
            "this sensor measures how far light went, and of light between surfaces no renderer "
            "says it: leave light=bounced out, or set light.bounces=0"
        )
