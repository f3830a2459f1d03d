"""`result.pt`: a run's classifier and what using it takes, as tensors and plain values.

A file that somebody else made is not trusted: it is read without unpickling objects, every value's
kind is checked, and the net it asks for must be one of `qs3.models`.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.evaluation.ood import MEASURES
from qs3.runs.checkpoints import save
from qs3.utils.version import VERSION

FILE = "result.pt"
PACKAGES = ("qs3.models",)
"""Packages that a file may take its net from."""

_TARGET = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
_MOST_POINTS = 1 << 20  # of a cloud; more is a damaged number


@dataclass(frozen=True, eq=False)
class Result:
    """A trained classifier, not yet built.

    Attributes:
        model: the config it is built from, resolved: `_target_` and plain arguments.
        classes: names in label order.
        points: of a cloud as the net sees it.
        stored_points: of a cloud of the target as it is stored, before sampling.
        target: name of the domain it was adapted to.
        gravity: the axis that points up in the clouds, "z"; "none": camera frame.
        usual: of each measure of `qs3.evaluation.ood` the range in training, [low, high].
        weights: of the net.
    """

    model: Mapping[str, Any]
    classes: tuple[str, ...]
    points: int
    stored_points: int
    target: str
    gravity: str
    usual: Mapping[str, list[float]]
    weights: Mapping[str, Tensor]


def write_result(path: Path, result: Result) -> None:
    """Save it, atomically."""
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    save({"qs3": VERSION, **values, "classes": list(result.classes)}, path)


def find_result(path: str | Path) -> Path:
    """The file meant by a run's folder, or by the file itself.

    Raises:
        MissingDataError: there is none; says what lies there instead.
    """
    path = Path(path).expanduser()
    if path.is_file():
        return path
    if not path.is_dir():
        raise MissingDataError(f"{path} is not there; give the folder of a finished run")
    if (path / FILE).is_file():
        return path / FILE
    if (path / "started.json").is_file():
        raise MissingDataError(
            f"{path} is the folder of a run that is not finished: it has no {FILE}; repeat its "
            "command, which goes on where it stopped"
        )
    inside = sorted(str(file.parent) for file in path.glob(f"*/{FILE}"))
    there = f", e.g. {inside[0]}" if inside else ""
    raise MissingDataError(f"{path} has no {FILE}; give the folder of a finished run{there}")


def read_result(path: str | Path) -> Result:
    """Read and check what `write_result` wrote; nothing in the file is run.

    Args:
        path: a run's folder, or the file.

    Raises:
        MissingDataError: no such file.
        DataError: damaged, or not a result.
    """
    file = find_result(path)
    try:
        found = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged and for malicious files
        raise DataError(
            f"{file} is damaged, or holds more than weights and plain values "
            f"({type(error).__name__}); nothing in it was run"
        ) from error
    return _checked(file, found)


def build_net(result: Result, packages: Sequence[str] = PACKAGES) -> nn.Module:
    """The net in eval mode, with its weights, on the CPU.

    Args:
        result: as read from a file that need not be trusted.
        packages: where the net may be defined. Your own net: `("qs3.models", "my_package")`.

    Raises:
        DataError: a net from elsewhere, or weights that are not this net's.
    """
    settings = dict(result.model)
    target = settings.pop("_target_")
    make = _maker(target, packages)
    try:
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and replaced
            net = make(**settings)
    except (TypeError, ValueError, ConfigError) as error:
        raise DataError(f"{target} cannot be built as the file says: {error}") from error
    if not isinstance(net, nn.Module):
        raise DataError(f"the file's model {target} is not a net; refused")
    try:
        net.load_state_dict(dict(result.weights))
    except RuntimeError as error:
        first = str(error).splitlines()[1:2] or [str(error)]
        raise DataError(f"the file's weights are not those of {target}: {first[0].strip()}") from (
            error
        )
    return net.eval()


def _maker(target: str, packages: Sequence[str]) -> Any:
    """The class or function, if it is defined in one of the packages itself."""
    module_name, _, name = target.rpartition(".")
    if not any(module_name.startswith(f"{package}.") for package in packages):
        raise DataError(
            f"the file's model is {target}, which is not in {' or '.join(packages)}; refused"
        )
    try:
        make = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError) as error:
        raise DataError(f"the file's model {target} is not in this version of qs3") from error
    if getattr(make, "__module__", None) != module_name or not callable(make):
        raise DataError(f"the file's model {target} is not defined there; refused")
    return make


def _names(value: Any) -> bool:
    named = isinstance(value, list) and all(isinstance(name, str) and name for name in value)
    return named and len(value) >= 2 and len(set(value)) == len(value)


def _is_model(value: Any) -> bool:
    """A `_target_` and arguments that are plain values; no other key of Hydra's."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        return False
    arguments = {key: one for key, one in value.items() if key != "_target_"}
    target = value.get("_target_")
    plain = all(not key.startswith("_") and _plain(one) for key, one in arguments.items())
    return plain and isinstance(target, str) and bool(_TARGET.fullmatch(target))


def _number_of_points(value: Any) -> bool:
    return type(value) is int and 1 <= value <= _MOST_POINTS


def _ranges(value: Any) -> bool:
    return isinstance(value, dict) and all(
        name in MEASURES
        and isinstance(ends, list)
        and len(ends) == 2
        and all(isinstance(end, float) and not math.isnan(end) for end in ends)
        for name, ends in value.items()
    )


def _are_weights(found: Any) -> bool:
    return (
        isinstance(found, dict)
        and len(found) > 0
        and all(isinstance(k, str) and isinstance(v, Tensor) for k, v in found.items())
    )


def _plain(value: Any) -> bool:
    """Numbers, words, None, and lists of them: what a net's arguments are."""
    if isinstance(value, list):
        return all(_plain(each) for each in value)
    return value is None or isinstance(value, bool | int | float | str)


_EXPECTED: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "model": (_is_model, "a dict with a `_target_` and plain arguments"),
    "classes": (_names, "a list of names, all different"),
    "points": (_number_of_points, f"from 1 to {_MOST_POINTS}"),
    "stored_points": (_number_of_points, f"from 1 to {_MOST_POINTS}"),
    "target": (lambda value: isinstance(value, str), "a name"),
    "gravity": (lambda value: value in ("z", "none"), "'z' or 'none'"),
    "usual": (_ranges, f"[low, high] of {', '.join(MEASURES)}"),
    "weights": (_are_weights, "names and tensors"),
}
"""Of each value of a file what it must be, and that in words."""


def _checked(file: Path, found: Any) -> Result:
    """The file's values as a `Result`.

    Raises:
        DataError: names the first one that is not as it should be.
    """
    found = found if isinstance(found, dict) else {}
    values = {key: found.get(key) for key in _EXPECTED}
    wrong = {key: words for key, (fits, words) in _EXPECTED.items() if not fits(values[key])}
    if not wrong and values["points"] > values["stored_points"]:
        wrong = {"points": "at most stored_points"}
    for key, words in wrong.items():
        raise DataError(
            f"{file} is not a result that qs3 wrote, or damaged: {key!r} should be {words}"
        )
    return Result(**{**values, "classes": tuple(values["classes"])})
