"""Materials of Wavefront OBJ: the .mtl files next to it, and which faces have which.

Of a material Kd, Ks, Ns, d and Tr are read, and Pr and Pm of the physically based extension. Kd is
linear light, as Blender takes it. A library that is not there, or not within the mesh's folder, is
left out: its faces have no material. Pictures (map_Kd) are not opened.

A name is all that follows on its line: many have spaces, and 3ds Max writes "Material #25".

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

_NAMED = (b"newmtl", b"usemtl", b"mtllib")


def read_finishes(data: bytes, folder: Path, found: FoundFinishes) -> None:
    """The materials of an OBJ file's faces, in their order.

    Raises:
        MeshError: a library is too large, or holds text where numbers are expected.
    """
    data = _joined_lines(data)
    known: dict[str, Finish | None] = {}
    pictured: set[str] = set()
    there, outside = _libraries(data, folder)
    if outside:
        names = ", ".join(f"{name!r:.200}" for name in outside[:3])
        found.notes.append(
            f"mtllib {names} lies outside of the mesh's folder and is not opened: its faces have "
            "no material. Put the file next to the mesh, and its bare name into the line"
        )
    for path in there:
        _read_library(path, known, pictured)
    numbers: dict[str, int] = {}
    of_face: list[int] = []
    counts: list[int] = []
    current = NONE
    for line in lines(data):
        tokens = _words(line)
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
        MeshError: it names more than MAX_LIBRARIES that are there.
    """
    if path.suffix.lower() != ".obj":
        return []
    return _libraries(_joined_lines(path.read_bytes()), path.parent)[0]


def _libraries(data: bytes, folder: Path) -> tuple[list[Path], list[str]]:
    """The files that are there, and the names of such as lie outside of the folder."""
    root = folder.resolve()
    outside: dict[str, None] = {}
    there: dict[Path, None] = {}
    for line in lines(data):
        if b"mtllib" not in line:
            continue
        keyword, *words = _words(line) or [b""]
        if keyword != b"mtllib":
            continue
        # One name that may have spaces, or several without.
        for names in ([_name(words)], [_name([word]) for word in words]):
            paths = [path for name in names for path in _inside(root, name, outside)]
            there.update(dict.fromkeys(paths))
            if paths:
                break
        if len(there) > MAX_LIBRARIES:
            raise MeshError(f"refers to more than {MAX_LIBRARIES} files of materials")
    return list(there), list(outside)


def _inside(root: Path, name: str, outside: dict[str, None]) -> list[Path]:
    """The file of this name, if it is there; added to `outside` if it is not in the folder."""
    for spelt in (name, name.replace("\\", "/")):  # as Windows writes it
        try:
            path = (root / spelt).resolve()
            if not path.is_relative_to(root):
                outside[name] = None
            elif path.is_file():
                return [path]
        except (OSError, RuntimeError):  # a name that no file can have, links in a circle
            continue
    return []


def _words(line: bytes) -> list[bytes]:
    """Those of a line, without a comment; a name may have a # in it."""
    if line.lstrip().startswith(_NAMED):
        words = line.split()
        if words[0] in _NAMED:
            return words
    return line.split(b"#", 1)[0].split()


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
        tokens = _words(line)
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
