"""A trained classifier on disk: a run's `result.pt`, or a folder that model hubs know.

    result.pt           all of a `Result`
    FOLDER/
      model.safetensors   the net's weights
      config.json         the rest of it, as plain values by name, and the weights' SHA-256
      README.md           a card for people, with the metadata that hubs read at its top

`config.json` has the form that huggingface_hub's `PyTorchModelHubMixin` passes to a class. A file
is read without unpickling objects, weights with another hash are refused, and the net it asks for
must be one of `qs3.models`. Classifiers that come with qs3 are such folders, found by their names;
none has seen a real scan.
"""

import dataclasses
import hashlib
import importlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import safetensors.torch
import torch
from annotated_types import Ge, Gt, Len
from jaxtyping import Float
from pydantic import ConfigDict, Field, TypeAdapter
from torch import Tensor, nn

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.runs.checkpoints import load, save
from qs3.utils.files import atomic_path, make_folder, reading, sha256_file, write_json, write_text
from qs3.utils.text_table import printable
from qs3.utils.version import VERSION

FILE = "result.pt"
WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
PACKAGES = ("qs3.models",)
"""Packages that a file may take its net from."""

PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"
ANY_SIZE, HEIGHTS = "dgcnn-speckle", "dgcnn-rooms"
"""Used where no classifier is named: for clouds of any unit and place, and for those in metres
with a known floor; then the former is a second opinion."""

_HASH = "weights_sha256"


@dataclasses.dataclass(frozen=True, eq=False)
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
            "above_floor" if it knows heights, too, or "seen" if it also knows where the camera is.
        usual: of each measure of `qs3.evaluation.ood` the range in training, [low, high].
        weights: of the net.
        floor_m: z of the floor in the target's clouds, of a net that knows heights; else None.
        worth: accuracy on real objects, in a sentence; "" if it was not measured.
        data: what its source and target are made of, in a sentence; "" if that is not known.
        learnt: shares of the classes in its training, see `qs3.evaluation.prior`; None if they
            are not known.
    """

    model: dict[str, Any]
    classes: Annotated[tuple[str, ...], Len(2)]
    points: Annotated[int, Ge(1)]
    stored_points: Annotated[int, Ge(1)]
    target: str
    gravity: Annotated[str, Field(pattern="^(z|none)$")]
    scale: Annotated[str, Field(pattern="^(unit_ball|metres|above_floor|seen)$")]
    usual: dict[str, Annotated[list[float], Len(2, 2)]]
    weights: dict[str, Tensor]
    floor_m: float | None = None
    worth: str = ""
    data: str = ""
    learnt: tuple[Annotated[float, Gt(0)], ...] | None = None

    __pydantic_config__ = ConfigDict(arbitrary_types_allowed=True, extra="forbid")

    def __repr__(self) -> str:
        """Net, classes, points, scale and target, in a line."""
        net = self.model["_target_"].rpartition(".")[2]
        return printable(
            f"{net}, {len(self.classes)} classes: {', '.join(self.classes)}; "
            f"{self.points} points, scale {self.scale}, target {self.target}"
        )

    @property
    def shares(self) -> Float[np.ndarray, " c"] | None:
        """`learnt` as an array."""
        return None if self.learnt is None else np.array(self.learnt)

    @property
    def own_module(self) -> str:
        """Where the net is defined, of a net that is not one of qs3; else ""."""
        module = str(self.model["_target_"]).rpartition(".")[0]
        return "" if f"{module}.".startswith(f"{PACKAGES[0]}.") else module


_RESULT = TypeAdapter(Result)


def pretrained_names() -> list[str]:
    """Names of the classifiers that come with qs3."""
    return sorted(path.parent.name for path in PRETRAINED.glob(f"*/{CONFIG}"))


def pretrained_name(file: Path) -> str | None:
    """The name of the classifier whose weights a file holds; None of other files."""
    folder = file.resolve().parent
    return folder.name if folder.parent == PRETRAINED else None


def write_result(path: Path, result: Result) -> None:
    """Save it, atomically."""
    save({"qs3": VERSION, **_RESULT.dump_python(result)}, path)


def write_folder(folder: Path, result: Result, card: str) -> None:
    """Write the files of a folder with this card; others in it are left alone."""
    make_folder(folder)
    (folder / CONFIG).unlink(missing_ok=True)  # it is written last, and marks the others as whole
    with atomic_path(folder / WEIGHTS) as path:
        weights = {name: value.contiguous() for name, value in result.weights.items()}
        safetensors.torch.save_file(weights, path, {"format": "pt"})
    write_text(folder / CARD, card)
    about = {"library_name": "qs3", "qs3": VERSION, _HASH: sha256_file(folder / WEIGHTS)}
    # JSON has no infinity: an open end in `usual` is null.
    plain = json.loads(_RESULT.dump_json(result, exclude={"weights"}))
    write_json(folder / CONFIG, about | plain)


def find_result(path: str | Path) -> Path:
    """The file meant by a name, by the folder of a run or of an exported model, or by a file."""
    if str(path) in pretrained_names() and not Path(path).exists():
        path = PRETRAINED / path
    path = Path(path).expanduser()
    for file in (path, path / FILE, path / WEIGHTS):
        if file.is_file():
            return file
    raise MissingDataError(
        f"{path} is not a finished run, nor one of {', '.join(pretrained_names())}"
    )


def read_result(path: str | Path) -> Result:
    """Read and check what `write_result` or `write_folder` wrote; nothing in it is run."""
    file = find_result(path)
    if file.name != WEIGHTS:
        return _checked(file, load(file))
    config = file.with_name(CONFIG)
    with reading(config):
        values, data = json.loads(config.read_bytes()), file.read_bytes()
        known = values.pop(_HASH)
        assert hashlib.sha256(data).hexdigest() == known, f"the SHA-256 of {WEIGHTS} is not {_HASH}"
        values["weights"] = safetensors.torch.load(data)
        values["usual"] = {
            name: [-math.inf if low is None else low, math.inf if high is None else high]
            for name, (low, high) in values["usual"].items()
        }
        del values["library_name"]
    return _checked(config, values)


def build_net(result: Result, packages: Sequence[str] = PACKAGES) -> nn.Module:
    """The net in eval mode, with its weights, on the CPU; the file need not be trusted.

    `packages`: where the net may be defined. Your own net: `("qs3.models", "my_package")`.
    """
    arguments = dict(result.model)
    target = str(arguments.pop("_target_", ""))
    make = _maker(target, packages)
    try:
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and replaced
            net: nn.Module = make(**arguments)
        net.load_state_dict(result.weights)
    except (TypeError, ValueError, RuntimeError, AttributeError, ConfigError) as error:
        first = " ".join(str(error).split()[:40])
        raise DataError(f"the file's {target} cannot be built from it: {first}") from error
    return net.eval()


def _maker(target: str, packages: Sequence[str]) -> Any:
    """The class or function, if it is defined in one of the packages (or modules) itself."""
    packages = (packages,) if isinstance(packages, str) else packages
    module, _, name = target.rpartition(".")
    make, why = None, f"it is not defined in {' or '.join(packages)}"
    if any(f"{module}.".startswith(f"{package}.") for package in packages):
        try:
            make = getattr(importlib.import_module(module), name, None)
        except ImportError as error:
            why = str(error)
    if not callable(make) or getattr(make, "__module__", None) != module:
        raise DataError(f"the file's model {target} is refused: {why}; see packages=")
    return make


def _checked(file: Path, found: Any) -> Result:
    """The file's values as a `Result`."""
    with reading(file):
        return _RESULT.validate_python({k: found[k] for k in found if k != "qs3"})
