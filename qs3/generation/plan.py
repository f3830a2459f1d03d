"""What generate.py is about to do: its config, built and judged in one place, and written down.

What is written down decides the bytes of a dataset: a resume is compared with it.
"""

import ast
import dataclasses
import functools
import hashlib
import json
import math
import platform
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen
from omegaconf import DictConfig, OmegaConf
from pydantic import ValidationError

from qs3.catalogue import Catalogue
from qs3.classes import CLASSES
from qs3.config.hydra import build
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError
from qs3.generation.kept import Keep, save_view
from qs3.generation.released import read_poses
from qs3.generation.rooms import Rooms
from qs3.meshes.folder import SPLITS, MeshFolder, classes_below
from qs3.meshes.io import Up
from qs3.meshes.mesh import MeshItem
from qs3.meshes.scenes import buffer_files
from qs3.store.parts import VIEWS as VIEWS_FOLDER
from qs3.utils.files import sha256_file
from qs3.utils.settings import Count, problems, settings
from qs3.utils.version import VERSION

_ROOT = Path(__file__).resolve().parents[1]
MAKES_CLOUDS = (
    *("catalogue", "generation", "meshes", "sensors"),
    *("geometry/cameras.py", "geometry/sampling.py"),
    *("datasets/cutting.py", "datasets/depth_images.py"),
    *("utils/seeding.py", "classes.py"),
)
"""Folders and modules that decide the bytes of a cloud."""

_ADDED = "catalogue-"  # before the names of objects that fill up the user's
_OTHER_HALF = 1000
_NOT_DECISIVE = ("threads", "python")  # of a renderer: its versions are written down apart
# Keys of a config that name places, or that never change a byte.
_UNSTORED = ("paths", "workers", "engine", "force", "strict")
_OF_LOOKING = ("sensor", "views", "provenance", "keep_views", "poses")


@settings
class Options:
    """The plain settings of conf/generate.yaml, which describes them."""

    seed: Annotated[int, Ge(0)]
    meshes: Annotated[str, MinLen(1)] | None
    fill_up: bool
    poses: Annotated[str, MinLen(1)] | None
    half: Literal["all", "first", "second"]
    test_fraction: Annotated[float, Gt(0), Lt(1)]
    up: Up
    colliders: Literal["skip", "keep"]
    classes: Annotated[tuple[str, ...], MinLen(1)] | None
    splits: Annotated[tuple[Literal["train", "test"], ...], MinLen(1)] | None
    limit: Count | None
    fraction: Annotated[float, Gt(0), Le(1)]
    scans: Count
    provenance: bool
    keep_views: bool
    workers: Annotated[int, Ge(0)]
    force: bool
    strict: bool


@dataclass(frozen=True, eq=False)
class Plan:
    """A config of generate.py, built and judged.

    Attributes:
        cfg: conf/generate.yaml, composed.
        options: its plain settings.
        domain: what is made.
        recipe: a `Recipe`, with the fields of its class.
    """

    cfg: DictConfig
    options: Options
    domain: Domain
    recipe: Any

    @property
    def classes(self) -> tuple[str, ...]:
        """The wanted ones, in label order."""
        wanted = self.options.classes or self.domain.names
        return tuple(name for name in self.domain.names if name in wanted)

    @property
    def renderer(self) -> dict[str, Any]:
        """How a renderer is built: plain values, for workers; empty where nothing is rendered."""
        found: Any = OmegaConf.to_container(
            self.cfg.get("renderer") or DictConfig({}), resolve=True
        )
        return dict(found)

    @property
    def mesh_root(self) -> Path:
        """The user's folder of meshes; absolute, as workers may be in other folders."""
        return Path(self.options.meshes or "").expanduser().absolute()

    @property
    def mesh_folder(self) -> MeshFolder:
        """The user's meshes."""
        return MeshFolder(
            path=self.mesh_root,
            classes=self.options.classes,
            test_fraction=self.options.test_fraction,
            half=self.options.half,
            known=self.domain.names,
            keep_colliders=self.options.colliders == "keep",
            up=self.options.up,
            optional=CLASSES if self.options.fill_up else (),
        )

    @functools.cached_property
    def items(self) -> list[MeshItem]:
        """The objects to scan, of the user's folder or of the embedded catalogue."""
        own = self.options.meshes is not None
        meshes = self._chosen(self.mesh_folder.items()) if own else self._of_the_catalogue()
        # The same mesh under another id has other randomness; scan 0 keeps its id.
        items = [
            replace(item, id=f"{item.id}~{scan}") if scan else item
            for item in meshes
            for scan in range(self.options.scans)
        ]
        if own and self.options.fill_up:
            items = self._filled_up(items)
        names = Counter(item.id for item in items)
        if same := [name for name, count in names.items() if count > 1]:
            raise ConfigError(f"two objects would be called {same[0]!r}: rename a mesh file")
        return items

    @functools.cached_property
    def tasks(self) -> list[MeshItem]:
        """What is scanned one by one: the objects or, furnished with them, rooms."""
        if not isinstance(self.recipe, Rooms):
            return self.items
        load: Any = {split: partial(str, split) for split in SPLITS}  # of a room its split
        return [
            MeshItem(f"room/{split}/room_{k:06d}", "", split, load[split], "")
            for split, meshes in self.recipe.shelves.items()
            for k in range(math.ceil(self.cfg.rooms * len(meshes)))
        ]

    @property
    def catalogue_seed(self) -> int:
        """Another one for the other half of meshes: catalogues of two seeds share no mesh."""
        other = _OTHER_HALF if self.options.half == "second" else 0
        return int(self.cfg.catalogue.seed) + other

    def _of_the_catalogue(self) -> list[MeshItem]:
        classes = tuple(name for name in CLASSES if name in self.classes)
        catalogue: Catalogue = build(self.cfg.catalogue, classes=classes, seed=self.catalogue_seed)
        return self._chosen(catalogue.items())

    def _chosen(self, items: Sequence[MeshItem]) -> list[MeshItem]:
        """Those of the wanted splits, as many as `limit` and `fraction` allow."""
        items = [item for item in items if item.split in (self.options.splits or SPLITS)]
        totals = Counter((item.cls, item.split) for item in items)
        seen: Counter[tuple[str, str]] = Counter()
        kept = []
        for item in items:
            group = (item.cls, item.split)
            wanted = math.ceil(self.options.fraction * totals[group] - 1e-9)
            if seen[group] < min(wanted, self.options.limit or wanted):
                kept.append(item)
            seen[group] += 1
        return kept

    def _filled_up(self, own: Sequence[MeshItem]) -> list[MeshItem]:
        """The user's scans, and of each class and split what they lack of the catalogue's number.

        The catalogue's objects have ids of their own: ModelNet's files, too, are called chair_0001.
        """
        catalogue = self._of_the_catalogue()
        lacking = Counter((item.cls, item.split) for item in catalogue)
        lacking.subtract(Counter((item.cls, item.split) for item in own))
        added = []
        for item in catalogue:
            if lacking[item.cls, item.split] > 0:
                lacking[item.cls, item.split] -= 1
                folder, stem = item.id.rsplit("/", 1)
                added.append(replace(item, id=f"{folder}/{_ADDED}{stem}"))
        order = {name: k for k, name in enumerate(self.domain.names)}
        return sorted([*own, *added], key=lambda item: (order[item.cls], SPLITS.index(item.split)))

    def keep(self, folder: Path) -> Keep:
        """What is wanted besides the clouds: provenance, and views."""
        save = partial(save_view, folder / VIEWS_FOLDER) if self.options.keep_views else None
        return Keep(self.options.provenance, save)

    def describe(self, renderer: Mapping[str, str]) -> dict[str, Any]:
        """All that decides the bytes of a dataset: what a resume is compared with.

        A folder of meshes is described by the content of its files, not by where it lies.
        """
        return {
            "kept": [key for key in ("provenance", "keep_views") if self.cfg[key]],
            "settings": self._settings(),
            "objects": [_name_and_content(item) for item in self.items],
            "versions": {
                **renderer,
                "qs3": VERSION,
                "numpy": version("numpy"),
                "opencv": version("opencv-python-headless"),
                "machine": platform.machine(),
            },
        }

    def _settings(self) -> dict[str, Any]:
        """The settings that decide the bytes of an object, as plain values."""
        plain: Any = OmegaConf.to_container(self.cfg, resolve=True)
        meshes: Any = {**plain["catalogue"], "seed": self.catalogue_seed}
        if self.options.meshes is not None:
            meshes = {"folder, filled up by": meshes} if self.options.fill_up else "folder"
        recipe = plain["recipe"]
        poses = recipe.pop("poses", None) or {}
        if path := poses.pop("path", None):  # a hash of them in its place
            recipe["poses"] = {**poses, "sha256": read_poses(Path(path).expanduser()).sha256}
        chosen = {
            "domain": self.domain.folder.name,
            "seed": plain["seed"],
            "recipe": recipe,
            "meshes": meshes,
            "colliders": plain["colliders"],
            "up": plain["up"],
        }
        if "rooms" in plain:
            chosen["rooms"] = plain["rooms"]
        if plain.get("renderer"):
            decisive = {k: v for k, v in plain["renderer"].items() if k not in _NOT_DECISIVE}
            chosen["renderer"] = decisive
        return chosen

    def stored_config(self) -> dict[str, Any]:
        """The composed config as meta.yaml holds it: all but places and what changes no byte."""
        plain: Any = OmegaConf.to_container(self.cfg, resolve=False)
        for key in _UNSTORED:
            plain.pop(key, None)
        for key in _NOT_DECISIVE:
            plain.get("renderer", {}).pop(key, None)
        plain["meshes"] = plain["meshes"] and "folder"
        plain["poses"] = plain["poses"] and "file"
        return plain

    def benchmark(self, recipe: Mapping[str, Any]) -> str:
        """Whether this is the benchmark that a domain's version names, a split of it, or another.

        "kinectsim10 v2"; "kinectsim10 v2, train" for its train part alone; "kinectsim10 v2 with
        other settings or objects"; empty for domains without a version.
        """
        stated = self.cfg.get("benchmark")
        if stated is None:
            return ""
        name = f"{self.domain.name} v{stated.version}"
        if plan_hash(recipe) == stated.plan_sha256:
            return name
        splits = self.options.splits
        if splits and self.options.meshes is None:
            whole = replace(self, options=dataclasses.replace(self.options, splits=None)).items
            part = [_name_and_content(item) for item in whole if item.split in splits]
            full = {**recipe, "objects": [_name_and_content(item) for item in whole]}
            if recipe["objects"] == part and plan_hash(full) == stated.plan_sha256:
                return f"{name}, {' and '.join(splits)}"
        return f"{name} with other settings or objects"


def planned(cfg: DictConfig) -> Plan:
    """Build and judge a config of generate.py."""
    try:
        plain: Any = OmegaConf.to_container(cfg, resolve=True)
        options = Options(**{one.name: plain[one.name] for one in dataclasses.fields(Options)})
    except ValidationError as error:
        raise ConfigError(problems(error)) from None
    plan = Plan(cfg, options, build(cfg.domain), build(cfg.recipe))
    if isinstance(plan.recipe, Rooms):
        if options.meshes and plan.domain.classes is None and not options.fill_up:
            names = classes_below(plan.mesh_root)
            if names and tuple(names) != CLASSES:
                plan = replace(plan, domain=replace(plan.domain, classes=list(names)))
        of = {split: tuple(i for i in plan.items if i.split == split) for split in SPLITS}
        shelves = {split: items for split, items in of.items() if items}
        plan = replace(plan, recipe=replace(plan.recipe, shelves=shelves))
    there = plan.domain.names if options.meshes else CLASSES
    if unknown := sorted({*(options.classes or plan.domain.names)} - {*there}):
        raise ConfigError(f"classes: {unknown} are not among {', '.join(there)}; see meshes=PATH")
    if unused := _unused(cfg, plan.recipe):
        raise ConfigError(f"domain {plan.domain.name} has no use for {unused[0]}=: leave it out")
    return plan


def _unused(cfg: DictConfig, recipe: Any) -> list[str]:
    """Keys that are given and that change nothing: figures would name them all the same."""
    if not recipe.needs_renderer:
        return [key for key in _OF_LOOKING if cfg.get(key)]
    no_use = {
        "poses": "poses" not in cfg.recipe,
        "provenance": isinstance(recipe, Rooms),
        "materials": not recipe.sensor.sees_light,
        "light": not recipe.sensor.sees_light,
    }
    return [key for key, without in no_use.items() if without and cfg.get(key)]


def plan_hash(recipe: Mapping[str, Any]) -> str:
    """Hash of settings and objects, without versions, modules and the renderer's variant."""
    plan = {"settings": dict(recipe["settings"]), "objects": recipe["objects"]}
    renderer = dict(plan["settings"].get("renderer", {}))
    renderer.pop("variant", None)
    plan["settings"]["renderer"] = renderer
    text = re.sub(r'"_target_": "[\w.]+\.', '"_target_": "', json.dumps(plan, sort_keys=True))
    return hashlib.sha256(text.encode()).hexdigest()


def recipe_fingerprint(recipe: Mapping[str, Any], made: Iterable[str]) -> str:
    """Twelve digits of settings, objects, libraries and code, the same on every machine.

    Compilers round differently on different processors, so that two machines may make clouds that
    differ in a few points. Their content hashes differ, this does not: results may be averaged.
    `recipe` is that of `Plan.describe`, `made` are ids of the objects that have a cloud.
    """
    of_the_machine = ("machine", "llvm", "width")
    versions = {k: v for k, v in recipe["versions"].items() if k not in of_the_machine}
    decides = [plan_hash(recipe), versions, code_fingerprint(), sorted(made)]
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]


@functools.cache
def code_fingerprint(root: Path = _ROOT) -> str:
    """Hash of the code that makes clouds: the same whatever its comments and docstrings."""
    digest = hashlib.sha256()
    for name in MAKES_CLOUDS:
        for path in [root / name] if name.endswith(".py") else sorted((root / name).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                if isinstance(body := getattr(node, "body", None), list):
                    body[:] = [line for line in body if not _is_text(line)]
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(ast.dump(tree).encode())
    return digest.hexdigest()


def _is_text(line: ast.AST) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)


def _name_and_content(item: MeshItem) -> str:
    if item.path is None:
        return f"{item.id} {item.origin}"
    files = [item.path, *buffer_files(item.path)]
    return f"{item.id} {item.origin} {' '.join(sha256_file(path)[:16] for path in files)}"
