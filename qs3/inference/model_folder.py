"""A classifier as a folder that model hubs know: weights, settings and a card, no pickle.

    model.safetensors   the net's weights
    config.json         what building and using the net takes, and the weights' SHA-256
    README.md           a card for people, with the metadata that hubs read at its top
    held_out.safetensors  what the net says of held-out labelled clouds; not in older folders
    trained_norms.safetensors  the norms of training, if those of the net follow its target: it is
                        the net with these that held_out.safetensors tells of

`config.json` holds plain values by name, as huggingface_hub's `PyTorchModelHubMixin` passes them
to a class; such a folder can be uploaded as it is (`upload_folder`). It is trusted as little as
`result.pt`: nothing in it is run, sizes are checked before memory is taken, and weights with
another hash are refused.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.errors import DataError
from qs3.inference.tensor_file import MAX_BYTES, read_tensors, write_tensors
from qs3.utils.files import make_folder, sha256_file, write_json, write_text
from qs3.utils.memory import read_whole
from qs3.utils.version import VERSION

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
HELD_OUT = "held_out.safetensors"
_HASH = "weights_sha256"
_BESIDE = {"held_out": HELD_OUT, "trained_norms": "trained_norms.safetensors"}
"""Tensors that not every classifier has, each with its hash in config.json, NAME_sha256."""
_MAX_CONFIG = 1 << 20  # bytes


def write_folder(folder: Path, values: Mapping[str, Any], card: str) -> None:
    """Write the files; others in the folder are left alone.

    Args:
        folder: made if need be.
        values: of a `qs3.inference.model_file.Result`, by name.
        card: Markdown.
    """
    make_folder(folder)
    (folder / CONFIG).unlink(missing_ok=True)  # it is written last, and marks the others as whole
    write_tensors(folder / WEIGHTS, values["weights"], {"format": "pt"})
    write_text(folder / CARD, card)
    hashes = {_HASH: sha256_file(folder / WEIGHTS)}
    for name, file in _BESIDE.items():
        (folder / file).unlink(missing_ok=True)
        if values[name] is not None:
            write_tensors(folder / file, values[name], {})
            hashes[_hash_of(name)] = sha256_file(folder / file)
    plain = {name: value for name, value in values.items() if name not in ("weights", *_BESIDE)}
    plain["usual"] = {name: _open(ends) for name, ends in values["usual"].items()}
    about = {"library_name": "qs3", "qs3": VERSION, **hashes}
    write_json(folder / CONFIG, {**about, **plain})


def read_folder(folder: Path) -> dict[str, Any]:
    """The values that `write_folder` wrote, not yet checked but for the weights.

    Raises:
        DataError: a file is missing, damaged or too large, or the weights are not those that
            config.json names.
    """
    values = _config(folder / CONFIG)
    weights = _tensors(folder / WEIGHTS, _HASH, values.pop(_HASH, None))
    hashes = {name: values.pop(_hash_of(name), None) for name in _BESIDE}
    named = {name: _BESIDE[name] for name, found in hashes.items() if found is not None}
    beside: dict[str, Any] = dict.fromkeys(_BESIDE)
    # Hubs may carry the weights alone; and held_out without its norms would judge another net.
    if all((folder / file).exists() for file in named.values()):
        for name, file in named.items():
            beside[name] = _tensors(folder / file, _hash_of(name), hashes[name])
    usual = values.get("usual")
    if isinstance(usual, Mapping):
        values["usual"] = {name: _closed(ends) for name, ends in usual.items()}
    return {**values, "weights": weights, **beside}


def _hash_of(name: str) -> str:
    return f"{name}_sha256"


def _tensors(path: Path, key: str, expected: Any) -> dict[str, Any]:
    data = _bytes(path, MAX_BYTES)
    if hashlib.sha256(data).hexdigest() != expected:
        raise DataError(
            f"{path} is damaged, or not of the {CONFIG} beside it (its SHA-256 is not {key} "
            "there); fetch or export both again"
        )
    return read_tensors(data, path)


def _config(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(_bytes(path, _MAX_CONFIG).decode())
        if not isinstance(values, dict):
            raise ValueError("it is not a JSON object")
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is damaged: not JSON as it should be ({error})") from error
    return values


def _bytes(path: Path, most: int) -> bytes:
    try:
        size = path.stat().st_size
        if size > most:
            raise DataError(f"{path} has {size} bytes, more than {most}")
        return read_whole(path, 2)  # and the tensors
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error


def _open(ends: list[float]) -> list[float | None]:
    """JSON has no infinity: an open end is null."""
    return [None if math.isinf(end) else end for end in ends]


def _closed(ends: Any) -> Any:
    if not isinstance(ends, list) or len(ends) != 2:
        return ends  # refused by its type
    low, high = ends
    return [-math.inf if low is None else low, math.inf if high is None else high]
