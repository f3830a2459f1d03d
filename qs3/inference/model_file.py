"""`result.pt`: a run's classifier and what using it takes, as tensors and plain values.

A file that somebody else made is not trusted: it is read without unpickling objects, every value's
kind is checked, and the net it asks for must be one of `qs3.models`.
"""

from __future__ import annotations

import importlib
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from torch import Tensor, nn

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.evaluation.ood import ALL as MEASURES_OF_CLOUDS
from qs3.inference import pretrained
from qs3.inference.held_out import checked_tensors, is_plain
from qs3.inference.model_folder import CONFIG, WEIGHTS, read_folder
from qs3.runs.checkpoints import load, save
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted
from qs3.utils.text_table import printable
from qs3.utils.version import VERSION

FILE = "result.pt"
EXPORTED = (".onnx", ".pt2")
"""What `qs3 export` writes for other programs."""

PACKAGES = ("qs3.models",)
"""Packages that a file may take its net from."""

_TARGET = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")


_MOST_VALUES = 10_000  # among a net's arguments
_ADVICE = (
    "it is damaged, or holds more than weights and plain values, and nothing in it was run; copy "
    "it again from where it comes from, or delete metrics.json in its run's folder and repeat the "
    "run's command, which trains nothing again"
)


def _plain(values: list[Any]) -> bool:
    """Numbers, words, None, and lists of them, not too many: what a net's arguments are."""
    waiting, seen = [values], 0
    while waiting:  # lists in a file may hold each other, or themselves
        some = waiting.pop()
        seen += len(some)
        lists = [one for one in some if isinstance(one, list)]
        if seen > _MOST_VALUES or not all(
            one is None or isinstance(one, bool | int | float | str | list) for one in some
        ):
            return False
        waiting += lists
    return True


def _model(value: dict[str, Any]) -> dict[str, Any]:
    """A `_target_` and arguments that are plain values; no other key of Hydra's."""
    target, odd = str(value.get("_target_")), [key for key in value if key.startswith("_")]
    plain = _plain(list(value.values()))
    if odd != ["_target_"] or not plain or not _TARGET.fullmatch(target):
        raise ValueError("should be a dict with a `_target_` and plain arguments")
    return value


def _different(value: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(value)) < max(len(value), 2):
        raise ValueError("should be at least two names, all different")
    return value


def _ranges(value: dict[str, list[float]]) -> dict[str, list[float]]:
    odd = any(math.isnan(x) for ends in value.values() for x in ends)
    if odd or not set(value) <= {*MEASURES_OF_CLOUDS}:
        raise ValueError(f"should be [low, high] of {', '.join(MEASURES_OF_CLOUDS)}")
    return value


def _printable(value: str) -> str:
    """It is printed on terminals."""
    if not value.isprintable():
        raise ValueError("should be a line of printable text")
    return value


_LONGEST = 1000  # characters of a sentence
_Points = Annotated[int, Field(strict=True, ge=1, le=1 << 20)]  # more is a damaged number
_Share = Annotated[float, Field(strict=True, gt=0, le=1)]
_Ends = Annotated[list[Annotated[float, Field(strict=True)]], Field(min_length=2, max_length=2)]


@dataclass(frozen=True, eq=False)
class Result:
    """A trained classifier, not yet built. What is read from a file is checked by these types.

    Attributes:
        model: the config it is built from, resolved: `_target_` and plain arguments.
        classes: names in label order.
        points: of a cloud as the net sees it; at most stored_points.
        stored_points: of a cloud of the target as it is stored, before sampling.
        target: name of the domain it was adapted to.
        gravity: the axis that points up in the clouds, "z"; "none": camera frame.
        scale: of a cloud as the net sees it: "unit_ball", "metres" if it knows sizes, or
            "above_floor" if it knows heights, too.
        usual: of each measure of `qs3.evaluation.ood` the range in training, [low, high].
        weights: of the net.
        floor_m: z of the floor in the target's clouds, of a net that knows heights; else None.
        worth: what it was found to be worth on real objects, in a sentence; "" if nobody looked.
        held_out: what the net says of held-out labelled clouds, by which its answers to others are
            judged; see `qs3.inference.held_out`. None in files of older versions.
        learnt: shares of the classes in its training, by which a prior is weighed; see
            `qs3.evaluation.prior`. None in files of older versions.
        trained_norms: those of the weights that clouds of the target changed after training
            (`evaluation.norms`), as training left them, by name: `held_out` is of the net with
            these. None: nothing did, or the file is of an older version.
    """

    model: Annotated[dict[str, Any], AfterValidator(_model)]
    classes: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], AfterValidator(_different)]
    points: _Points
    stored_points: _Points
    target: str
    gravity: Annotated[str, Field(pattern="^(z|none)$")]
    scale: Annotated[str, Field(pattern="^(unit_ball|metres|above_floor)$")]
    usual: Annotated[dict[str, _Ends], AfterValidator(_ranges)]
    weights: Annotated[dict[str, Tensor], Field(min_length=1)]
    floor_m: Annotated[float, Field(strict=True, allow_inf_nan=False)] | None = None
    worth: Annotated[str, Field(max_length=_LONGEST), AfterValidator(_printable)] = ""
    held_out: Annotated[dict[str, Tensor], AfterValidator(checked_tensors)] | None = None
    learnt: tuple[_Share, ...] | None = None
    trained_norms: Annotated[dict[str, Tensor], Field(min_length=1)] | None = None

    __pydantic_config__ = ConfigDict(arbitrary_types_allowed=True)

    def __repr__(self) -> str:
        """In a line: its weights, as the dataclass has them, fill a terminal."""
        return f"Result({self.told})"

    @property
    def before_target(self) -> Result:
        """The same with the norms it was trained with."""
        weights = {**self.weights, **(self.trained_norms or {})}
        return replace(self, weights=weights, trained_norms=None)

    @property
    def told(self) -> str:
        """Net, classes, points, scale and target, for people."""
        net = self.model["_target_"].rpartition(".")[2]
        return printable(
            f"{net}, {counted(len(self.classes), 'class', 'classes')}: {', '.join(self.classes)}; "
            f"{counted(self.points, 'point')}, scale {self.scale}, target {self.target}"
        )


def write_result(path: Path, result: Result) -> None:
    """Save it, atomically."""
    save({"qs3": VERSION, **values_of(result)}, path)


def values_of(result: Result) -> dict[str, Any]:
    """By name, as tensors and plain values."""
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    return {**values, "classes": list(result.classes)}


def find_result(path: str | Path) -> Path:
    """The file meant by the folder of a run or of an exported model, or by the file itself.

    Also by the name of a classifier that comes with qs3.

    Raises:
        MissingDataError: there is none; says what lies there instead.
        ConfigError: a net that `qs3 export` wrote as one file.
    """
    path = pretrained.folder_of(path) or Path(path).expanduser()
    if path.suffix.lower() in EXPORTED and path.is_file():
        raise ConfigError(
            f"{path} is a net for other programs, without what prepares its clouds; give the run "
            "or the classifier that it was exported from"
        )
    if path.is_file():
        return path
    if not path.is_dir():
        own = f", or one of {', '.join(names)}" if (names := pretrained.names()) else ""
        raise MissingDataError(f"{path} is not there; give the folder of a finished run{own}")
    for name in (FILE, WEIGHTS):
        if (path / name).is_file():
            return path / name
    if (path / "started.json").is_file():
        raise MissingDataError(
            f"{path} is the folder of a run that is not finished: it has no {FILE}; repeat its "
            "command, which goes on where it stopped"
        )
    inside = sorted(str(file.parent) for file in path.glob(f"*/{FILE}"))
    there = f", e.g. {inside[0]}" if inside else ""
    raise MissingDataError(f"{path} has no {FILE}; give the folder of a finished run{there}")


def read_result(path: str | Path) -> Result:
    """Read and check what `write_result` wrote, in a run's folder or file; nothing in it is run.

    Also a folder of `qs3.inference.model_folder`.

    Raises:
        MissingDataError: no such file.
        DataError: damaged, or not a result.
    """
    file = find_result(path)
    if file.name == WEIGHTS:
        return _checked(file.parent / CONFIG, read_folder(file.parent))
    return _checked(file, load(file, advice=_ADVICE))


def own_module(result: Result) -> str:
    """Where the net is defined, of a net that is not one of qs3; else ""."""
    module = str(result.model["_target_"]).rpartition(".")[0]
    return "" if f"{module}.".startswith(f"{PACKAGES[0]}.") else module


def build_net(result: Result, packages: Sequence[str] = PACKAGES) -> nn.Module:
    """The net in eval mode, with its weights, on the CPU; the file need not be trusted.

    `packages`: where the net may be defined. Your own net: `("qs3.models", "my_package")`.

    Raises:
        DataError: a net from elsewhere, or weights that are not this net's.
    """
    settings = dict(result.model)
    target = settings.pop("_target_")
    make = _maker(target, packages)
    if not own_module(result):  # one's own is trusted with any arguments
        with torch.device("meta"), warnings.catch_warnings():  # takes no memory
            warnings.simplefilter("ignore", UserWarning)  # nothing is copied there: as is meant
            net = _filled(make, settings, result, target)
        values = net.state_dict().values()
        check_memory(sum(x.numel() * x.element_size() for x in values), f"the file's {target}")
    with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and replaced
        return _filled(make, settings, result, target).eval()


def _filled(make: Any, settings: dict[str, Any], result: Result, target: str) -> nn.Module:
    """The net with its weights; DataError as of `build_net`."""
    try:
        net = make(**settings)
    except (
        TypeError,
        LookupError,
        ValueError,
        ArithmeticError,
        RuntimeError,
        ConfigError,
    ) as error:
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
    return net


def _maker(target: str, packages: Sequence[str]) -> Any:
    """The class or function, if it is defined in one of the packages (or modules) itself."""
    packages = (packages,) if isinstance(packages, str) else packages
    module_name, _, name = target.rpartition(".")
    if not any(f"{module_name}.".startswith(f"{package}.") for package in packages):
        raise DataError(
            f"the file's model is {target}, which is not in {' or '.join(packages)}; refused. "
            "If it is a net of your own, name its package: "
            "qs3.load(run, packages=['qs3.models', 'my_package']), or packages=my_package in a "
            "command"
        )
    try:
        make = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError) as error:
        if target.startswith(f"{PACKAGES[0]}."):
            raise DataError(f"the file's model {target} is not in this version of qs3") from error
        raise DataError(
            f"the file's model {target} cannot be imported here ({error}); its module must be on "
            "the Python path: PYTHONPATH=FOLDER before the command"
        ) from error
    if getattr(make, "__module__", None) != module_name or not callable(make):
        raise DataError(f"the file's model {target} is not defined there; refused")
    return make


def _unlike(some: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> bool:
    """Whether one has no weight of its name, size and type, or is no plain tensor."""
    for name, one in some.items():
        other = weights.get(name)
        if other is None or one.dtype != other.dtype:
            return True
        if not (is_plain(one) and is_plain(other) and one.shape == other.shape):
            return True
    return False


def _checked(file: Path, found: Any) -> Result:
    """The file's values as a `Result`.

    Raises:
        DataError: names the first one that is not as it should be.
    """
    try:
        result = TypeAdapter(Result).validate_python(found)
    except ValidationError as error:
        first = error.errors()[0]
        place, why = ".".join(map(str, first["loc"])) or "the file", first["msg"]
    else:
        if result.points > result.stored_points:
            place, why = "points", "should be at most stored_points"
        elif (result.scale == "above_floor") != (result.floor_m is not None):
            place, why = "floor_m", "should be a number for scale above_floor, and for no other"
        elif result.held_out and result.held_out["probabilities"].shape[1] != len(result.classes):
            place, why = "held_out", "should have a probability for each class"
        elif result.learnt is not None and len(result.learnt) != len(result.classes):
            place, why = "learnt", "should have a share for each class"
        elif _unlike(result.trained_norms or {}, result.weights):
            place, why = "trained_norms", "should be some of the weights, of the same sizes"
        else:
            return result
    raise DataError(f"{file} is not a result that qs3 wrote, or damaged: {place}: {why}")
