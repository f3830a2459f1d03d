"""Materials of Wavefront OBJ: the .mtl files next to it, and which faces have which.

Of a material Kd, Ks, Ns, d and Tr are read, and Pr and Pm of the physically based extension. Kd is
linear light, as Blender takes it. A library that is not there is left out: its faces have no
material. Pictures (map_Kd) are not opened.

http://paulbourke.net/dataformats/mtl/
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.finishes import MAX_FINISHES, NONE, Finish, FoundFinishes
from qs3.meshes.formats.arrays import lines

MAX_BYTES = 1 << 24
MAX_LIBRARIES = 64


def read_finishes(data: bytes, folder: Path, found: FoundFinishes) -> None:
    """The materials of an OBJ file's faces, in their order.

    Raises:
        MeshError: a library lies outside of the folder, is too large, or holds text where numbers
            are expected.
    """
    data = _joined_lines(data)
    known: dict[str, Finish | None] = {}
    pictured: set[str] = set()
    for path in _libraries(data, folder):
        _read_library(path, known, pictured)
    numbers: dict[str, int] = {}
    of_face: list[int] = []
    counts: list[int] = []
    current = NONE
    for line in lines(data):
        tokens = line.split(b"#", 1)[0].split()
        if not tokens:
            continue
        if tokens[0] == b"usemtl":
            current = numbers.setdefault(_name(tokens[1:]), len(numbers))
            if current >= MAX_FINISHES:
                raise MeshError(f"has more than {MAX_FINISHES} materials")
        elif tokens[0] == b"f":
            of_face.append(current)
            counts.append(max(len(tokens) - 3, 0))
    each = np.repeat(np.array(of_face, np.int64), np.array(counts, np.int64))
    in_pictures = [number for name, number in numbers.items() if name in pictured]
    found.pictured += int(np.isin(each, in_pictures).sum())
    found.add_each(each, [None if name in pictured else known.get(name) for name in numbers])


def libraries(path: Path) -> list[Path]:
    """The .mtl files that an OBJ file names and that are there, each once; empty of other files.

    Raises:
        MeshError: one of them lies outside of its folder.
    """
    if path.suffix.lower() != ".obj":
        return []
    return _libraries(_joined_lines(path.read_bytes()), path.parent)


def _libraries(data: bytes, folder: Path) -> list[Path]:
    root = folder.resolve()
    there: dict[Path, None] = {}
    for line in lines(data):
        if b"mtllib" not in line:
            continue
        keyword, *words = line.split(b"#", 1)[0].split() or [b""]
        if keyword != b"mtllib":
            continue
        # One name that may have spaces, or several without.
        whole = _inside(root, _name(words))
        for path in [whole] if whole else [_inside(root, _name([word])) for word in words]:
            if path is not None:
                there[path] = None
        if len(there) > MAX_LIBRARIES:
            raise MeshError(f"refers to more than {MAX_LIBRARIES} files of materials")
    return list(there)


def _inside(root: Path, name: str) -> Path | None:
    """The file of this name, if it is there; MeshError if it lies outside of the folder."""
    for spelt in (name, name.replace("\\", "/")):  # as Windows writes it
        try:
            path = (root / spelt).resolve()
            if not path.is_relative_to(root):
                raise MeshError(f"refers to {name!r:.200}, which lies outside of its folder")
            if path.is_file():
                return path
        except (OSError, RuntimeError):  # a name that no file can have, links in a circle
            continue
    return None


def _name(words: Sequence[bytes]) -> str:
    """A name may have spaces; NUL cannot be in a path."""
    return b" ".join(words).decode("utf-8", "surrogateescape").replace("\0", "")[:1000]


def _joined_lines(data: bytes) -> bytes:
    return data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ") if b"\\" in data else data


def _read_library(path: Path, known: dict[str, Finish | None], pictured: set[str]) -> None:
    if path.stat().st_size > MAX_BYTES:
        raise MeshError(f"refers to {path.name}, which has more than {MAX_BYTES} bytes")
    entries: dict[str, dict[str, list[bytes]]] = {}
    current: dict[str, list[bytes]] = {}
    for line in lines(path.read_bytes()):
        tokens = line.split(b"#", 1)[0].split()
        if tokens and tokens[0] == b"newmtl":
            current = entries.setdefault(_name(tokens[1:]), {})
            if len(entries) > MAX_FINISHES:
                raise MeshError(f"refers to {path.name}, with more than {MAX_FINISHES} materials")
        elif tokens:
            current[tokens[0].decode("latin-1")] = tokens[1:]
    for name, entry in entries.items():
        try:
            known[name] = _finish(entry)
        except ValueError as error:
            raise MeshError(f"{path.name}: material {name!r:.80}: {error}") from error
        if "map_Kd" in entry:
            pictured.add(name)


def _finish(entry: dict[str, list[bytes]]) -> Finish | None:
    """None without a colour, or with one that is not RGB."""
    colour = entry.get("Kd", [])
    if not colour or colour[0] in (b"spectral", b"xyz"):
        return None
    red, *others = (_unit(word, "Kd") for word in colour[:3])
    green, blue = others if len(others) == 2 else (red, red)  # as the format says
    roughness = 0.5
    if "Pr" in entry:
        roughness = _unit(_one(entry, "Pr"), "Pr")
    elif "Ns" in entry:
        # Blinn and Phong's exponent n is about 2 / alpha^2 - 2, and alpha is roughness^2.
        roughness = (2 / (max(_number(_one(entry, "Ns"), "Ns"), 0) + 2)) ** 0.25
    shine = entry.get("Ks", [])
    specular = 0.5
    if shine and shine[0] not in (b"spectral", b"xyz"):
        specular = float(np.mean([_unit(word, "Ks") for word in shine[:3]]))
    clear = 0.0
    if "d" in entry:
        clear = 1 - _unit(entry["d"][-1] if entry["d"] else b"", "d")  # d -halo FACTOR
    elif "Tr" in entry:
        clear = _unit(_one(entry, "Tr"), "Tr")
    metal = "Pm" in entry and _unit(_one(entry, "Pm"), "Pm") >= 0.5
    return Finish((red, green, blue), roughness, specular, metal, clear)


def _one(entry: dict[str, list[bytes]], key: str) -> bytes:
    return entry[key][0] if entry[key] else b""


def _unit(word: bytes, key: str) -> float:
    return min(max(_number(word, key), 0.0), 1.0)


def _number(word: bytes, key: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{key} is no number: {word[:40].decode('ascii', 'replace')!r}")
    return value
