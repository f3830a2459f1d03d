"""`result.pt`: a run's classifier and what using it takes, as tensors and plain values.

A file that somebody else made is not trusted: it is read without unpickling objects, every value's
kind is checked, and the net it asks for must be one of `qs3.models`.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
    plain = {
        "qs3": VERSION,
        "model": dict(result.model),
        "classes": list(result.classes),
        "points": result.points,
        "stored_points": result.stored_points,
        "target": result.target,
        "gravity": result.gravity,
        "usual": {name: list(ends) for name, ends in result.usual.items()},
        "weights": dict(result.weights),
    }
    save(plain, path)


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
    inside = sorted(file.parent for file in path.glob(f"*/{FILE}"))
    if inside:
        names = ", ".join(str(folder) for folder in inside[:5]) + ", ..." * (len(inside) > 5)
        raise MissingDataError(f"{path} is no run; it holds {len(inside)} of them: {names}")
    raise MissingDataError(f"{path} has no {FILE}; give the folder of a finished run")


def read_result(path: str | Path) -> Result:
    """Read and check what `write_result` wrote; nothing in the file is run.

    Args:
        path: a run's folder, or the file.

    Raises:
        MissingDataError: no such file.
        DataError: damaged, not a result, or of an older version.
    """
    file = find_result(path)
    try:
        found = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged and for malicious files
        raise DataError(
            f"{file} is damaged, or holds more than weights and plain values "
            f"({type(error).__name__}); nothing in it was run"
        ) from error
    if _are_weights(found):
        raise DataError(
            f"{file} holds weights alone, as an older version wrote it; delete metrics.json beside "
            "it and repeat the run's command: it trains nothing again and writes the file anew"
        )
    return _Checked(file, found).result()


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
        raise DataError(f"the file's model {target} is no net; refused")
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


class _Checked:
    """Takes the values out of a file's dict, naming the one that is not as it should be."""

    def __init__(self, file: Path, found: Any) -> None:
        self.file = file
        self.found = found if isinstance(found, dict) else {}

    def result(self) -> Result:
        classes = self._of("classes", list)
        unique = len({name for name in classes if isinstance(name, str) and name})
        if len(classes) < 2 or unique != len(classes):
            raise self._wrong("classes", "names, all different")
        model = self._of("model", dict)
        target = model.get("_target_")
        if not isinstance(target, str) or not _TARGET.fullmatch(target):
            raise self._wrong("model", "a dict with a `_target_`")
        if not all(_plain(value) for key, value in model.items() if key != "_target_") or not all(
            isinstance(key, str) and (key == "_target_" or not key.startswith("_")) for key in model
        ):
            raise self._wrong("model", "arguments that are plain values")
        weights = self._of("weights", dict)
        if not _are_weights(weights):
            raise self._wrong("weights", "names and tensors")
        points, stored = self._points("points"), self._points("stored_points")
        if points > stored:
            raise self._wrong("points", f"at most stored_points, {stored}")
        gravity = self._of("gravity", str)
        if gravity not in ("z", "none"):
            raise self._wrong("gravity", "'z' or 'none'")
        target_name = self._of("target", str)
        usual = self._usual()
        return Result(model, tuple(classes), points, stored, target_name, gravity, usual, weights)

    def _usual(self) -> dict[str, list[float]]:
        usual = self._of("usual", dict)
        for name, ends in usual.items():
            known = name in MEASURES and isinstance(ends, list) and len(ends) == 2
            if not known or not all(isinstance(e, float) and not math.isnan(e) for e in ends):
                raise self._wrong("usual", f"[low, high] of {', '.join(MEASURES)}")
        return usual

    def _points(self, key: str) -> int:
        value = self._of(key, int)
        if isinstance(value, bool) or not 1 <= value <= _MOST_POINTS:
            raise self._wrong(key, f"1 to {_MOST_POINTS}")
        return value

    def _of(self, key: str, kind: type) -> Any:
        value = self.found.get(key)
        if not isinstance(value, kind):
            raise self._wrong(key, f"a {kind.__name__}")
        return value

    def _wrong(self, key: str, expected: str) -> DataError:
        return DataError(
            f"{self.file} is not a result that qs3 wrote, or damaged: {key!r} should be {expected}"
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
