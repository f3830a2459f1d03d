"""What a generated dataset is made of, from its config and the meshes that were read."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from qs3.config.compose import choices, composed
from qs3.generation.plan import Plan, recipe_fingerprint
from qs3.store.meta import OK, MadeOf, ManifestRow

_MATERIALS = {"principled": "principled materials"}
_LIGHTS = {"area": "light above"}


def made_of(plan: Plan, rows: Sequence[ManifestRow], recipe: Mapping[str, Any]) -> MadeOf:
    """What was made, for figures; of a folder of meshes its last name, and not where it lies."""
    objects = "embedded catalogue"
    if plan.options.meshes is not None:
        root = plan.mesh_root.resolve()
        # Below `raw/` PyTorch Geometric and `qs3 download` keep what a dataset is made from.
        objects = f"meshes of {(root.parent if root.name == 'raw' else root).name}"
        objects += " and the embedded catalogue" * plan.options.fill_up
    made = {row.id for row in rows if row.status == OK}
    there = {row.cls for row in rows if row.status == OK}
    several = "\n".join(sorted({row.mesh_sha256 for row in rows} - {""}))
    return MadeOf(
        objects=objects,
        sensor=_sensor(plan.cfg),
        views=plan.cfg.views,
        without=", ".join(name for name in plan.domain.names if name not in there),
        benchmark=plan.benchmark(recipe),
        meshes=hashlib.sha256(several.encode()).hexdigest()[:12],
        recipe=recipe_fingerprint(recipe, made),
    )


@functools.cache
def _files(group: str) -> dict[str, Any]:
    """What each file of conf/`group` sets there, in one composition."""
    if group == "sensor":
        names = choices("sensor")
        files = composed(None, *(f"+sensor@{name}={name}" for name in names))
        found = {name: _plain(files[name]) for name in names}
        released = composed("generate", "domain=specklenet10", "released=yes")
        return found | {"speckle_stereo as released": _plain(released.sensor)}
    # These files are global: one composition each, and those that set nothing are left out.
    each = {name: composed(None, f"+{group}={name}").get(group) for name in choices(group)}
    return {name: _plain(found) for name, found in each.items() if found}


def _sensor(cfg: DictConfig) -> str:
    """The preset, materials and light, each with what was changed, and errors taken out."""
    if not cfg.get("sensor"):
        holes = " with holes" if cfg.recipe.get("dropout") else ""
        return f"surface samples{holes}"
    words = [_own_preset() or _named("sensor", cfg.sensor)]
    if kinds := cfg.get("materials"):
        words.append(_named("materials", kinds, _MATERIALS))
    if light := cfg.get("light"):
        words.append(_named("light", light, _LIGHTS))
    return ", ".join(words)


def _own_preset() -> str:
    """The name of a sensor's file that lies next to conf, and what was changed; "" if in conf."""
    if not HydraConfig.initialized():
        return ""
    hydra = HydraConfig.get()
    name = str(hydra.runtime.choices.get("sensor") or "")
    if not name or name in choices("sensor"):
        return ""
    words = [word.lstrip("+~") for word in hydra.overrides.task]
    changed = [word.removeprefix("sensor.") for word in words if word.startswith("sensor.")]
    return " ".join([name, *["with"] * bool(changed), *changed])


def _named(group: str, settings: DictConfig, words: Mapping[str, str] | None = None) -> str:
    """The file of conf/`group` that settings are most like, and what they have else.

    `words` has what each file is called; None: its name.
    """
    plain = _plain(settings)
    found: list[tuple[int, str, list[str]]] = []
    for name, file in _files(group).items():
        if file.get("_target_") == plain["_target_"]:
            changed = list(_differences(plain, file))
            found.append((len(changed), name, changed))
    if not found:  # of one's own
        return str(plain["_target_"].rsplit(".", 1)[-1])
    _, name, changed = min(found)
    return " ".join([(words or {}).get(name, name), *["with"] * bool(changed), *changed])


def _differences(
    given: Mapping[str, Any], file: Mapping[str, Any], above: str = ""
) -> Iterator[str]:
    """Each key, with dots, that has another value than in a file: "key=value" or "no key"."""
    for key in (*given, *(key for key in file if key not in given)):
        value, place = given.get(key), above + key
        other = file.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            yield from _differences(value, other, f"{place}.")
        elif key not in given:
            yield f"no {place}"
        elif key not in file or value != other:
            yield f"{place}={json.dumps(value)}".replace('"', "")


def _plain(settings: DictConfig) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(settings, resolve=True)
    return dict(plain)
