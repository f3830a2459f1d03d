"""What several readers share: small clouds, folders as one input, a half of all inputs."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np

from tests.fuzzing.mutate import zipped

CLOUD = np.arange(12, dtype=np.float64).reshape(4, 3) / 8
TWO = ("bed", "chair")


def bytes_of(*paths: Path) -> list[bytes]:
    return [path.read_bytes() for path in paths]


def folder_of(folder: Path) -> bytes:
    """All files below a folder as one input, which `laid_out` lays out again."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return zipped([(path.relative_to(folder).as_posix(), path.read_bytes()) for path in files])


def laid_out(path: Path) -> Path:
    """The folder of an input, if it is none yet; members with odd names are passed over."""
    if path.is_dir():
        return path
    root = path.parent / "folder"
    root.mkdir()
    try:
        with zipfile.ZipFile(path) as file:
            for info in file.infolist():
                name = info.filename
                parts = name.split("/")
                if name.isprintable() and len(name) < 100 and not {"", ".", ".."} & {*parts}:
                    at = root.joinpath(*parts[:-1])
                    at.mkdir(parents=True, exist_ok=True)
                    (at / parts[-1]).write_bytes(file.read(info))
    except Exception:  # a damaged input is a folder without the file, which is tried, too
        pass
    return root


def half_of_all(path: Path) -> bool:
    """Of half of all inputs: whether checksums shall be made to match."""
    return path.is_file() and bool(hashlib.sha256(path.read_bytes()).digest()[0] & 1)
