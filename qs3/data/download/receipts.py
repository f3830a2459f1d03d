"""Small notes beside a downloaded file: what it is, and what it was while it came."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple


class Receipt(NamedTuple):
    """What is known of a finished file; kept beside it as `name.json`."""

    url: str
    size: int
    sha256: str
    etag: str | None = None


def read_receipt(path: Path) -> Receipt | None:
    """The receipt of a finished file, or None if there is none that can be read."""
    values = read_json(beside(path, ".json"))
    try:
        receipt = Receipt(**values)
    except TypeError:
        return None
    whole = isinstance(receipt.size, int) and isinstance(receipt.sha256, str)
    return receipt if whole else None


def md5_file(path: Path) -> str:
    """MD5 of a file's bytes as 32 hex digits: Google states it, nothing rests on its strength."""
    digest = hashlib.md5(usedforsecurity=False)
    with open(path, "rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """A small JSON file of ours; {} if it is not there or damaged."""
    try:
        values = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def beside(path: Path, ending: str) -> Path:
    """The note of a file."""
    return path.with_name(path.name + ending)
