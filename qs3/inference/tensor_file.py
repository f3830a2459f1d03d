"""Tensors in a file of the safetensors format, which holds no code: written, and read with checks.

The format (https://huggingface.co/docs/safetensors, "Format"): the length of the header in 8 bytes,
little-endian; the header, a JSON object `{name: {"dtype", "shape", "data_offsets": [begin, end]}}`
and perhaps `__metadata__` of text; then the numbers, in C order and without holes. It has no
checksum: whoever needs one keeps it elsewhere (`qs3.inference.model_folder` does).
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qs3.errors import DataError
from qs3.utils.files import write_bytes

MAX_BYTES = 2 << 30
_MAX_HEADER = 16 << 20
_MOST = 1 << 62  # numbers as torch holds them, of strides too
_MAX_DIMENSIONS = 16
_TYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
_NAMES = {dtype: name for name, dtype in _TYPES.items()}
_METADATA = "__metadata__"


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Save them, atomically; the same tensors give the same bytes.

    Raises:
        DataError: numbers of a kind that the format does not have.
    """
    # As the format's own writer sorts them: the widest numbers first, so that all are aligned.
    order = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))
    header: dict[str, Any] = {_METADATA: dict(metadata)}
    parts, begin = [], 0
    for name in order:
        tensor = tensors[name].detach().cpu().contiguous()
        if tensor.dtype not in _NAMES:
            raise DataError(f"{path}: {name} is of {tensor.dtype}, which the format does not have")
        data = tensor.reshape(-1).view(torch.uint8).numpy().tobytes()
        end = begin + len(data)
        header[name] = {
            "dtype": _NAMES[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": [begin, end],
        }
        parts.append(data)
        begin = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    write_bytes(path, b"".join([len(text).to_bytes(8, "little"), text, *parts]))


def read_tensors(data: bytes, path: Path) -> dict[str, Tensor]:
    """The tensors of a file's bytes; nothing is believed before it fits these bytes.

    Raises:
        DataError: names `path`, and what is wrong.
    """
    if len(data) < 8:
        raise DataError(f"{path} has {len(data)} bytes: cut off")
    length = int.from_bytes(data[:8], "little")
    if not 2 <= length <= min(_MAX_HEADER, len(data) - 8):
        raise DataError(
            f"{path} has {len(data)} bytes and names a header of {length}: cut off, damaged, or "
            "not a safetensors file"
        )
    try:
        header = json.loads(data[8 : 8 + length].decode(), object_pairs_hook=_once)
        if not isinstance(header, dict):
            raise ValueError("it is not a JSON object")
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path} is damaged: its header is not as it should be ({error})"
        ) from error
    header.pop(_METADATA, None)
    body = memoryview(data)[8 + length :]
    found, ends = {}, [(0, 0, "the beginning")]
    for name, about in header.items():
        dtype, shape, begin, end = _entry(about, name, path)
        size = math.prod(shape) * dtype.itemsize
        if end - begin != size or end > len(body):
            raise DataError(
                f"{path} is damaged: {name} of shape {shape} lies at {begin} to {end} of "
                f"{len(body)} bytes, expected {size} of them"
            )
        ends.append((begin, end, name))
        found[name] = _tensor(body[begin:end], dtype, shape)
    ends = [*sorted(ends), (len(body), len(body), "the end")]
    for (_, before, one), (after, _, other) in itertools.pairwise(ends):
        if before != after:
            raise DataError(f"{path} is damaged: {one} ends at {before}, {other} begins at {after}")
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name occurs twice")
    return found


def _entry(about: Any, name: str, path: Path) -> tuple[torch.dtype, list[int], int, int]:
    """Type, shape, begin and end of a tensor; DataError if these are not what they should be."""
    try:
        dtype, shape = _TYPES[about["dtype"]], about["shape"]
        begin, end = about["data_offsets"]
        numbers = [*shape, begin, end]
        if len(shape) > _MAX_DIMENSIONS or {*map(type, numbers)} - {int} or min(numbers) < 0:
            raise ValueError
        if 0 in shape and math.prod(max(size, 1) for size in shape) > _MOST:
            raise ValueError  # no byte belongs to it, so nothing else bounds it
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} is damaged: {name!r} should have a dtype of {', '.join(_TYPES)}, a shape, "
            "and data_offsets, whole numbers"
        ) from error
    return dtype, shape, begin, end


def _tensor(data: memoryview, dtype: torch.dtype, shape: list[int]) -> Tensor:
    if not len(data):
        return torch.empty(shape, dtype=dtype)
    # A copy: the bytes may not be written to, and may not be aligned.
    return torch.frombuffer(bytearray(data), dtype=dtype).reshape(shape)
