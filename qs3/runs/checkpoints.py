"""Checkpoints that survive a kill at any moment: written to another file, flushed, renamed.

They hold weights and plain values only and are read with `weights_only=True`. torch writes a zip
with a checksum (CRC-32) of each tensor and never looks at it, so that a flipped bit would become
another weight; here it is compared whenever a file is read.
"""

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torch.serialization import get_unsafe_globals_in_checkpoint

from qs3.errors import ConfigError
from qs3.utils.files import reading, write_bytes

LAST = "last.ckpt"


def save(value: Any, path: str | os.PathLike[str]) -> None:
    """Save tensors and plain values to `path`, atomically; others, such as numpy's, are refused."""
    file = io.BytesIO()  # of a file that a full disk breaks off torch complains in its own words
    torch.save(value, file)
    file.seek(0)
    if kinds := get_unsafe_globals_in_checkpoint(file):
        raise ConfigError(f"{path} could not be read again: keep no {', '.join(kinds)} in it")
    write_bytes(path, file.getvalue())


def load(path: str | os.PathLike[str], device: Any = "cpu") -> Any:
    """Read what `save` wrote, after every checksum was compared."""
    with reading(path), open(path, "rb") as file:
        with zipfile.ZipFile(file) as archive:
            if (damaged := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"the checksum of {damaged} does not match")
        file.seek(0)
        return torch.load(file, map_location=device, weights_only=True)


def copy_weights(net: nn.Module) -> dict[str, torch.Tensor]:
    """The net's parameters and buffers, copied to the CPU."""
    return {name: value.detach().cpu().clone() for name, value in net.state_dict().items()}


def weights_sha256(weights: Mapping[str, torch.Tensor]) -> str:
    """A hash of names, types, shapes and values: equal for equal weights, in any order."""
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):  # safetensors has another order each time
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()
