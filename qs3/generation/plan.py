"""What generate.py is about to do: settings checked, objects listed, everything written down."""

from __future__ import annotations

import contextlib
import difflib
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

from qs3.classes import CLASSES, class_list
from qs3.config.checks import check_bool, check_choice, check_float, check_int, check_keys
from qs3.config.hydra import build
from qs3.data.dataset_folder import VIEWS as VIEWS_FOLDER
from qs3.errors import ConfigError, MeshError, MissingDataError
from qs3.generation.materials import OwnMaterials
from qs3.generation.provenance import Keep
from qs3.generation.released.poses import read_poses
from qs3.generation.twins import TWINS, VIEWS
from qs3.meshes.folder import SPLITS, MeshFolder
from qs3.meshes.formats.gltf import buffer_files
from qs3.meshes.formats.mtl import libraries
from qs3.meshes.source import MeshItem
from qs3.utils.files import sha256_file
from qs3.utils.version import VERSION

KEYS = (
    *("seed", "meshes", "fill_up", "poses", "half", "test_fraction", "up", "colliders", "classes"),
    *("splits", "limit", "fraction", "scans", "provenance", "keep_views", "twins", "workers"),
    *("shard_mb", "force", "strict", "paths", "domain", "catalogue", "renderer", "scene"),
    *("tracking", "crop", "views", "recipe", "sensor", "counts", "released", "engine"),
    *("materials", "light", "depth_errors", "benchmark", "cutting"),
)
"""The keys at the top of conf/generate.yaml and of all that it composes."""

_WHOLE = {"seed": 0, "workers": 0, "limit": 1, "scans": 1, "views": 0, "shard_mb": 1}
_NOT_DECISIVE = ("threads",)  # of a renderer: never changes a byte
COLLIDERS = ("skip", "keep")
UPS = ("auto", "z", "y")
_OWN_MATERIALS = f"{OwnMaterials.__module__}.{OwnMaterials.__name__}"
_SWITCHES = ("provenance", "keep_views", "force", "strict", "fill_up")
# Groups that say nothing to a domain that looks at nothing, by the empty choice that it has.
_OF_LOOKING = ("scene", "tracking", "crop")
_OF_LIGHT = ("materials", "light")
_OF_DEPTH = (*_OF_LIGHT, "depth_errors")
_ADDED = "catalogue-"  # before the names of objects that fill up the user's
_OTHER_HALF = 1000
_PREVIEWS = 2  # objects a class whose first view is kept for the contact sheet
# Keys of a config that say where things lie, or that never change a byte.
_UNSTORED = ("paths", "workers", "engine", "shard_mb", "force", "strict")


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

    for key in _OF_DEPTH:
        # Before the recipe is built: one that looks at nothing does not take them.
        if cfg.get(key) and not cfg.sensor:
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


def known_classes(cfg: DictConfig) -> tuple[str, ...]:
    """The classes of the domain, in label order."""
    return class_list(cfg.domain.get("classes"))


def check_recipe(recipe: Any, cfg: DictConfig) -> None:
    """Raise ConfigError if sensor or renderer are missing where the recipe needs them.

    And if something is asked for that a domain without views cannot give.
    """
    if not recipe.needs_renderer:
        for key in (*_OF_LOOKING, "provenance", "keep_views", "twins"):
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


def mesh_items(cfg: DictConfig) -> list[MeshItem]:
    """The objects to scan, from the user's folder or the embedded catalogue.

    `up` has been decided (`qs3.generation.up_axis`); undecided, it is z.
    """
    if cfg.meshes is None:
        if cfg.up == "y":
            raise ConfigError(
                "up=y is for meshes of yours, and the embedded catalogue has z up: give a folder "
                "with meshes=PATH, or leave it out"
            )
        if own_materials(cfg):
            raise ConfigError(
                "materials=own is for meshes of yours, and the embedded catalogue's have none: "
                "give a folder with meshes=PATH, or take materials=mixed"
            )
        wanted = set(cfg.classes or known_classes(cfg))
        if missing := sorted(wanted - set(CLASSES)):
            raise ConfigError(
                f"the embedded catalogue has no {', '.join(missing)}: give a folder of meshes with "
                "meshes=PATH, or only classes that it has, classes=[chair,table]"
            )
        items = _catalogue_items(cfg)
    else:
        items = _chosen(mesh_folder(cfg).items(), cfg)
    scans = [_scan_of(item, scan) for item in items for scan in range(cfg.scans)]
    names = Counter(item.id for item in scans)
    if same := next((item for item in items if names[item.id] > 1), None):
        raise ConfigError(
            f"{same.path}: with scans={cfg.scans} another mesh's scan is called {same.id!r}, too: "
            "rename the file"
        )
    return _filled_up(scans, cfg) if cfg.fill_up else scans


def _catalogue_items(cfg: DictConfig) -> list[MeshItem]:
    wanted = set(cfg.classes or known_classes(cfg))
    classes = tuple(name for name in CLASSES if name in wanted)
    return _chosen(build(cfg.catalogue, classes=classes, seed=_catalogue_seed(cfg)).items(), cfg)


def _catalogue_seed(cfg: Any) -> int:
    """Of the other half of meshes, another catalogue: catalogues of two seeds share no mesh."""
    return int(cfg["catalogue"]["seed"]) + (_OTHER_HALF if cfg["half"] == "second" else 0)


def _chosen(items: Sequence[MeshItem], cfg: DictConfig) -> list[MeshItem]:
    """Those of the wanted splits, as many as `limit` and `fraction` say."""
    wanted = [item for item in items if item.split in (cfg.splits or SPLITS)]
    return _first_of_each(wanted, cfg.limit, cfg.fraction)


def _filled_up(own: Sequence[MeshItem], cfg: DictConfig) -> list[MeshItem]:
    """The user's scans, and of each class and split what they lack of the catalogue's number.

    The catalogue's objects have ids of their own: ModelNet's files, too, are called chair_0001.
    """
    lacking = Counter((item.cls, item.split) for item in _catalogue_items(cfg))
    lacking.subtract(Counter((item.cls, item.split) for item in own))
    added = []
    for item in _catalogue_items(cfg):
        if lacking[item.cls, item.split] > 0:
            lacking[item.cls, item.split] -= 1
            folder, stem = item.id.rsplit("/", 1)
            added.append(replace(item, id=f"{folder}/{_ADDED}{stem}"))
    if same := sorted({item.id for item in own} & {item.id for item in added}):
        raise ConfigError(
            f"{same[0]} is what fill_up=true calls an object of the catalogue: rename the file"
        )
    order = {name: k for k, name in enumerate(known_classes(cfg))}
    return sorted([*own, *added], key=lambda item: (order[item.cls], SPLITS.index(item.split)))


def left_alone(cfg: DictConfig) -> list[str]:
    """Folders of other classes beside the user's; see `MeshFolder.left_alone`.

    Raises:
        MissingDataError: the user's folder is there no more.
    """
    try:
        return [] if cfg.meshes is None else mesh_folder(cfg).left_alone()
    except OSError as error:
        raise MissingDataError(
            f"{mesh_root(cfg)} cannot be read any more ({error.strerror}): run the same command "
            "again when it can, what is done is kept"
        ) from error


def mesh_folder(cfg: DictConfig) -> MeshFolder:
    """The user's meshes."""
    return MeshFolder(
        path=mesh_root(cfg),
        classes=tuple(cfg.classes) if cfg.classes else None,
        test_fraction=cfg.test_fraction,
        half=cfg.half,
        known=known_classes(cfg),
        keep_colliders=cfg.colliders == "keep",
        up="y" if cfg.up == "y" else "z",
        optional=CLASSES if cfg.fill_up else (),
        materials=own_materials(cfg),
    )


def own_materials(cfg: DictConfig) -> bool:
    """Whether mesh files are asked what they are made of."""
    return (cfg.get("materials") or {}).get("_target_") == _OWN_MATERIALS


def mesh_root(cfg: DictConfig) -> Path:
    """The user's folder of meshes; absolute, as workers may be in other folders."""
    return Path(cfg.meshes).expanduser().absolute()


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
        return {"folder, filled up by": {**plain["catalogue"], "seed": _catalogue_seed(plain)}}
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
