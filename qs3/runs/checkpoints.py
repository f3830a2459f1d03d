"""Checkpoints that survive a kill at any moment: written to another file, flushed, renamed.

They hold weights and plain values only and are read with `weights_only=True`. torch writes a zip
with a checksum (CRC-32) of each tensor and never looks at it, so that a flipped bit would become
another weight; here it is compared whenever a file is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import torch
from torch import nn
from torch.serialization import get_unsafe_globals_in_checkpoint

from qs3.errors import ConfigError, DataError
from qs3.utils.files import atomic_path
from qs3.utils.memory import check_memory

LAST = "last.ckpt"


def save(value: Any, path: str | os.PathLike[str]) -> None:
    """Save tensors and plain values to `path`, atomically.

    Raises:
        ConfigError: there is another value among them, such as numpy's: `load` would refuse it.
        Qs3Error: the file cannot be written (permission, full disk).
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save(value, file)
        except RuntimeError as error:  # torch's complaint of the half file hides what broke it off
            if isinstance(error.__context__, OSError | KeyboardInterrupt | SystemExit):
                raise error.__context__ from error
            raise
        file.flush()
        if get_unsafe_globals_in_checkpoint(temporary):
            place, kind = _not_plain(value)
            raise ConfigError(
                f"{place} is of type {kind}, and what a run goes on from has tensors and plain "
                "values alone, so that reading it runs no code: it could not be read again. Keep "
                "it as a number, text, list, dict or tensor, with float(...) say"
            )


def load(
    path: str | os.PathLike[str], device: Any = "cpu", advice: str = "start again with force=true"
) -> Any:
    """Read what `save` wrote; the disk is read once.

    Raises:
        DataError: the file is missing, damaged, or takes too much memory; ends with the advice.
    """
    with _intact(path, advice) as file:
        return torch.load(file, map_location=device, weights_only=True)


def check(path: str | os.PathLike[str], advice: str) -> None:
    """Raise DataError, which ends with the advice, if a file of `save` is missing or damaged."""
    with _intact(path, advice):
        pass


def copy_weights(net: nn.Module) -> dict[str, torch.Tensor]:
    """The net's parameters and buffers, copied to the CPU."""
    return {name: value.detach().cpu().clone() for name, value in net.state_dict().items()}


def weights_sha256(weights: Mapping[str, torch.Tensor]) -> str:
    """A hash of names, types, shapes and values: equal for equal weights, to the bit."""
    digest = hashlib.sha256()
    for name, value in weights.items():
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _not_plain(value: Any) -> tuple[str, str]:
    """Where in nested dicts and lists the first value is that `load` refuses, and its type."""
    pairs: Any = value.items() if isinstance(value, dict) else ()
    for key, one in enumerate(value) if isinstance(value, list | tuple) else pairs:
        file = io.BytesIO()
        torch.save(one, file)
        file.seek(0)
        if get_unsafe_globals_in_checkpoint(file):
            place, kind = _not_plain(one)
            return f"{key}.{place}" if place else str(key), kind
    return "", f"{type(value).__module__}.{type(value).__qualname__}"


@contextlib.contextmanager
def _intact(path: str | os.PathLike[str], advice: str) -> Iterator[BinaryIO]:
    """The open file, after every checksum was compared; all that is raised becomes a DataError."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            check_memory(size, path)
            with zipfile.ZipFile(file) as archive:
                if sum(info.file_size for info in archive.infolist()) > size:  # none is compressed
                    raise zipfile.BadZipFile("it promises more than it holds")
                if (damaged := archive.testzip()) is not None:
                    raise zipfile.BadZipFile(f"the checksum of {damaged} does not match")
            file.seek(0)
            yield file
    except DataError:
        raise
    except Exception as error:  # zipfile and torch raise many kinds for a damaged file
        why = ": ".join([type(error).__name__, *str(error).splitlines()[:1]])
        raise DataError(f"{path} cannot be read ({why}); {advice}") from error
