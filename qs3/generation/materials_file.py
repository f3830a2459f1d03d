"""`materials=PATH`: a YAML file of kinds of material, checked and put among the words of a command.

The file has the keys of conf/materials/mixed.yaml. Nothing of it is instantiated: its numbers
become a value of the config, so that they are part of a dataset's plan, whatever the file is called
and wherever it lies, and can be changed as those of any other choice (materials.kinds.a.weight=2).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from qs3.config.checks import check_float, check_int
from qs3.errors import ConfigError, DataError
from qs3.generation.materials import Kind, MixedMaterials, checked_kind
from qs3.utils.yamls import load_yaml

MAX_BYTES = 1 << 18
MAX_KINDS = 256

_KEY = "materials"
_TARGET = f"{MixedMaterials.__module__}.{MixedMaterials.__name__}"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
_NO_NAMES = ("true", "false", "null", "nan", "inf")  # other things in a word of Hydra's
_USED_IN = {_KEY: f"${{{_KEY}}}"}  # `recipe:` of the files of conf/materials
_EXAMPLE = "conf/materials/mixed.yaml is an example"


def with_materials(words: Iterable[str]) -> list[str]:
    """The words of a command with what a file of materials says in the place of its path.

    A value is a path if it has a slash or ends in .yaml or .yml; other words stay as they are.

    Raises:
        ConfigError: names the file and the key that is wrong.
    """
    plain: list[str] = []
    for word in words:
        key, _, value = word.partition("=")
        path = value.strip("'\"")
        if key == _KEY and ("/" in path or path.endswith((".yaml", ".yml"))):
            node = _as_word(read_materials(Path(path).expanduser()))
            plain += [f"+{_KEY}={node}", f"+recipe.{_KEY}=${{{_KEY}}}"]
        else:
            plain.append(word)
    return plain


def read_materials(path: Path) -> dict[str, Any]:
    """The node `materials` of a config, of plain values: its target is `MixedMaterials`.

    Raises:
        ConfigError: there is no such file, or it is too large, is not YAML, or has a key or a value
            that there is not; names the file and the key.
    """
    try:
        found = load_yaml(_text(path), path)
    except DataError as error:
        raise ConfigError(str(error)) from error
    try:
        return _checked(found)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _text(path: Path) -> str:
    if not path.is_file():
        what = "is not a file" if path.exists() else "there is no such file"
        raise ConfigError(f"materials={path}: {what}; {_EXAMPLE}")
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"materials={path}: cannot be read: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: has more than {MAX_BYTES} bytes; {_EXAMPLE}")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not text in UTF-8; {_EXAMPLE}") from error


def _checked(found: Any) -> dict[str, Any]:
    top = _mapping("", found, (_KEY, "recipe"), needed=(_KEY,))
    if top.get("recipe", _USED_IN) != _USED_IN:
        raise ConfigError(
            f"recipe: may say {_KEY}: {_USED_IN[_KEY]} and nothing else; leave it out"
        )
    node = _mapping(_KEY, top[_KEY], ("_target_", "max_materials", "kinds"), needed=("kinds",))
    if node.get("_target_", _TARGET) != _TARGET:
        raise ConfigError(f"{_KEY}._target_ must be {_TARGET}, or left out")
    most = check_int(f"{_KEY}.max_materials", node.get("max_materials", 3), 1)
    kinds = node["kinds"]
    if not isinstance(kinds, dict) or not 0 < len(kinds) <= MAX_KINDS:
        raise ConfigError(f"{_KEY}.kinds must name 1 to {MAX_KINDS} kinds of material; {_EXAMPLE}")
    plain = {name: _kind(name, values) for name, values in kinds.items()}
    MixedMaterials(plain, most)  # checks what the kinds are together
    return {"_target_": _TARGET, "max_materials": most, "kinds": plain}


def _kind(name: Any, values: Any) -> dict[str, Any]:
    place = f"{_KEY}.kinds"
    if not (isinstance(name, str) and _NAME.fullmatch(name)) or name.lower() in _NO_NAMES:
        raise ConfigError(
            f"{place}: {name!r:.80} is no name: letters, digits and _, a letter first"
        )
    known = fields(Kind)
    needed = tuple(field.name for field in known if field.default is MISSING)
    kind = _mapping(f"{place}.{name}", values, tuple(field.name for field in known), needed)
    check_float(f"{place}.{name}.weight", kind["weight"], "[0, 1000000]")
    checked_kind(name, kind)
    return kind


def _mapping(
    place: str, found: Any, known: Sequence[str], needed: Sequence[str] = ()
) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ConfigError(
            f"{place or 'the file'} must hold the keys {', '.join(known)}; {_EXAMPLE}"
        )
    if unknown := [key for key in found if key not in known]:
        raise ConfigError(
            f"{f'{place}.' * bool(place)}{unknown[0]!s:.80} is not known here; known are "
            f"{', '.join(known)} ({_EXAMPLE})"
        )
    if missing := [key for key in needed if key not in found]:
        raise ConfigError(f"{f'{place}.' * bool(place)}{missing[0]} is missing; {_EXAMPLE}")
    return found


def _as_word(value: Any) -> str:
    """As Hydra reads a value on a command line; texts here are names and a target."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_as_word(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_as_word, value)) + "]"
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)
