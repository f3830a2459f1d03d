"""Damage that knows what files are made of: bits, numbers, lines, trees of JSON, parts of archives.

An archive whose checksum is wrong is refused at its door. So parts are taken out, damaged, and put
in again as they should be; `Shape` says how.
"""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Part = tuple[str, bytes]


class Shape(NamedTuple):
    """How a file is taken apart and put together; taking apart may raise anything.

    `packs`: what repeats takes next to no bytes in it, so a part may become large.
    """

    open: Callable[[bytes], list[Part]]
    close: Callable[[list[Part]], bytes]
    packs: bool = False


MOST_BYTES = 1 << 16
"""Longer inputs are cut: they take time and find nothing new."""

_WIDTHS = (1, 2, 4, 8)
_BLOATED = (1 << 16, 1 << 20, 1 << 24)
_NUMBERS = (
    *("0", "-0", "-1", "1", "2", "7", "255", "256", "65536", "2147483647", "2147483648"),
    *("4294967296", "9223372036854775807", "18446744073709551616", "1e39", "-1e308", "1e999"),
    *("nan", "inf", "-inf", "0.5", "1e-320", "0x10", "1_0", "٣", "²", "9" * 30, "1" * 5000, ""),
)
_WORDS = ("", "\0", '"', ",", "\n", "null", "[]", "{}", "..", "/", "é", "\ud800", "&a ", "*a", "!!")
_DATES = ("2020-99-99", "2001-1-1", "0b", "~", ".inf", "<<", "!!python/none", "1:2:3")
_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1, 2**31, 2**63, 2**64, 10**40, 10**400, 0.5, -1e308, 1e308, [], {}, ""),
    *("x", "nan", [[]], [0], [None] * 20, {"": 0}, float("nan"), float("inf"), "\0", "\ud800"),
)
_TEXT = re.compile(rb"[\t\n\r -~\x80-\xff]*")
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]\w+")


def mutated(data: bytes, others: Sequence[bytes], shape: Shape | None, rng: random.Random) -> bytes:
    """Another input from one, and from others of the same format."""
    found = None
    if shape is not None and rng.random() < 0.8:
        found = _by_parts(data, others, shape, rng)
    if found is None:
        found = _bytes(data, rng.choice(others), rng)
    return found[:MOST_BYTES]


def _by_parts(
    data: bytes, others: Sequence[bytes], shape: Shape, rng: random.Random
) -> bytes | None:
    """The whole with a part damaged, missing, twice, renamed or from elsewhere; None: no parts."""
    try:
        parts = shape.open(data)
        foreign = shape.open(rng.choice(others))
        at = rng.randrange(len(parts))
        name, content = parts[at]
        how = rng.random()
        if shape.packs and how < 0.03:
            some = content[rng.randrange(len(content) + 1) :][: rng.choice((1, 64, 4096))] or b"\0"
            parts[at] = name, content + some * (rng.choice(_BLOATED) // len(some))
        elif how < 0.8:
            parts[at] = name, _bytes(content, rng.choice(foreign)[1], rng)
        elif how < 0.85:
            del parts[at]
        elif how < 0.9:
            parts.insert(rng.randrange(len(parts) + 1), parts[at])
        elif how < 0.95:
            changed = _bytes(name.encode("utf-8", "replace"), name.encode(), rng)
            parts[at] = changed.decode("utf-8", "replace"), content
        else:
            parts[at] = name, rng.choice(foreign)[1]
        return shape.close(parts)
    except Exception:  # of what was damaged before, or cannot be put together
        return None


def _bytes(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """One to a few changes; more of them are rarer."""
    for _ in range(1 + min(int(rng.expovariate(1)), 6)):
        kinds = [_bits, _blocks, _lengths, _splice]
        if data[:1] in (b"{", b"["):
            kinds += [_tree] * 4
        if data and _TEXT.fullmatch(data[:200]):
            kinds += [_lines, _figures, _words] * 2
        kind = rng.choice(kinds)
        data = kind(data, other, rng)
    return data


def _bits(data: bytes, other: bytes, rng: random.Random) -> bytes:
    out = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(out))
        out[at] = rng.choice((out[at] ^ 1 << rng.randrange(8), rng.randrange(256), 0, 255))
    return bytes(out)


def _blocks(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """Cut off, taken out, repeated or put in."""
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    b = min(b, a + rng.choice((1, 4, 16, 1 << 12)))
    match rng.randrange(5):
        case 0:
            return data[:a]
        case 1:
            return data[:a] + data[b:]
        case 2:
            return data[:b] + data[a:b] * rng.choice((1, 2, 50)) + data[b:]
        case 3:
            return data[:a] + rng.randbytes(rng.choice((1, 2, 8))) + data[a:]
        case _:
            return data + bytes(rng.choice((1, 7, 512)))


def _lengths(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """A number of 1 to 8 bytes at a limit, or next to what it was."""
    width = rng.choice(_WIDTHS)
    if len(data) < width:
        return data
    at, order = rng.randrange(len(data) - width + 1), rng.choice(("little", "big"))
    most = 1 << 8 * width
    was = int.from_bytes(data[at : at + width], order)
    new = rng.choice((0, 1, most - 1, most // 2, most // 2 - 1, was + 1, was - 1, 2 * was,
                      len(data), rng.randrange(most), 1 << rng.randrange(8 * width)))  # fmt: skip
    if width >= 4 and rng.random() < 0.2:
        code = {4: "f", 8: "d"}[width]
        new = int.from_bytes(struct.pack(f"<{code}", rng.choice(
            (float("nan"), float("inf"), -1.0, 1e38, 1e-40))), order)  # fmt: skip
    return data[:at] + (new % most).to_bytes(width, order) + data[at + width :]


def _splice(data: bytes, other: bytes, rng: random.Random) -> bytes:
    a, b = rng.randrange(len(data) + 1), rng.randrange(len(other) + 1)
    if rng.random() < 0.5:
        return data[:a] + other[b:]
    return data[:a] + other[b : b + rng.choice((4, 32, 256))] + data[a:]


def _lines(data: bytes, other: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True) or [b""]
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[a]
        case 1:
            lines[a], lines[b] = lines[b], lines[a]
        case 2:
            lines[a:a] = [lines[b]] * rng.choice((1, 1, 30))
        case _:
            lines[a] = rng.choice(other.splitlines(keepends=True) or [b""])
    return b"".join(lines)


def _figures(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """A number in digits becomes another one."""
    return _swapped(data, _NUMBER, rng.choice(_NUMBERS), rng)


def _words(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """A word becomes another one of the file or of another, or what is none."""
    known = _WORD.findall(other) or [b"x"]
    new = rng.choice((*_WORDS, *_DATES)).encode("utf-8", "surrogatepass")
    return _swapped(data, _WORD, new if rng.random() < 0.5 else rng.choice(known), rng)


def _swapped(data: bytes, what: re.Pattern, new: str | bytes, rng: random.Random) -> bytes:
    places = list(what.finditer(data))
    if not places:
        return data
    place = rng.choice(places)
    new = new.encode() if isinstance(new, str) else new
    return data[: place.start()] + new + data[place.end() :]


def _tree(data: bytes, other: bytes, rng: random.Random) -> bytes:
    """A value of JSON becomes one of another kind, goes, or comes again elsewhere."""
    try:
        tree = json.loads(data)
        places: list[tuple[Any, Any]] = []
        _collect(tree, places)
        holder, key = rng.choice(places)
        match rng.randrange(8):
            case 0:
                del holder[key]
            case 1:
                donor, name = rng.choice(places)
                holder[key] = donor[name]
            case 2:
                for _ in range(rng.choice((1, 3, 2000))):  # deep
                    holder[key] = [holder[key]]
            case _:
                holder[key] = rng.choice(_VALUES)
        return json.dumps(tree).encode()
    except (ValueError, RecursionError, IndexError):
        return _bits(data, other, rng)


def _collect(node: Any, places: list[tuple[Any, Any]]) -> None:
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in list(items):
        places.append((node, key))
        if isinstance(value, dict | list):
            _collect(value, places)


# ---- shapes ----


def _zip_parts(data: bytes) -> list[Part]:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return [(info.filename, file.read(info)) for info in file.infolist()]


def zipped(parts: list[Part], how: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of these members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", how) as file:
        for name, content in parts:
            file.writestr(zipfile.ZipInfo(name), content, how)
    return out.getvalue()


ZIP = Shape(_zip_parts, zipped)
PACKED = Shape(_zip_parts, lambda parts: zipped(parts, zipfile.ZIP_DEFLATED), packs=True)


def _png_parts(data: bytes) -> list[Part]:
    parts, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind = data[at + 4 : at + 8].decode("latin-1")
        content = data[at + 8 : at + 8 + length]
        parts.append((kind, zlib.decompress(content) if kind == "IDAT" else content))
        at += 12 + length
    return parts


def _png(parts: list[Part]) -> bytes:
    out = [b"\x89PNG\r\n\x1a\n"]
    for name, content in parts:
        kind = name.encode("latin-1")
        body = zlib.compress(content, 1) if kind == b"IDAT" else content
        out += [struct.pack(">I", len(body)), kind, body]
        out.append(struct.pack(">I", zlib.crc32(kind + body)))
    return b"".join(out)


PNG = Shape(_png_parts, _png, packs=True)


def _glb_parts(data: bytes) -> list[Part]:
    (length,) = struct.unpack_from("<I", data, 12)
    return [("JSON", data[20 : 20 + length].rstrip()), ("BIN", data[28 + length :])]


def _glb(parts: list[Part]) -> bytes:
    (_, text), *rest = parts
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    for _, content in rest:
        chunks += struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


GLB = Shape(_glb_parts, _glb)


def _tar_parts(data: bytes) -> list[Part]:
    return [("tar", zlib.decompress(data, 31) if data[:2] == b"\x1f\x8b" else data)]


def _tar(parts: list[Part]) -> bytes:
    """With the checksums of its headers, as far as they can be found; packed."""
    out, at = bytearray(parts[0][1]), 0
    while at + 512 <= len(out):
        if any(out[at : at + 512]):
            out[at + 148 : at + 156] = b" " * 8
            out[at + 148 : at + 156] = b"%06o\0 " % sum(out[at : at + 512])
            try:
                size = int(bytes(out[at + 124 : at + 135]), 8)
            except ValueError:
                size = 0
            at += min(size + 511, 1 << 20) // 512 * 512
        at += 512
    packer = zlib.compressobj(1, wbits=31)
    return packer.compress(bytes(out)) + packer.flush()


TAR_GZ = Shape(_tar_parts, _tar, packs=True)


def _safetensors_parts(data: bytes) -> list[Part]:
    parts = _zip_parts(data)
    found = []
    for name, content in parts:
        if name.endswith(".safetensors"):
            length = int.from_bytes(content[:8], "little")
            found.append((f"{name}:head", content[8 : 8 + length]))
            content = content[8 + length :]
        found.append((name, content))
    return found


def _safetensors(parts: list[Part]) -> bytes:
    head, out = b"", []
    for name, content in parts:
        if name.endswith(":head"):
            head = content
        elif name.endswith(".safetensors"):
            out.append((name, len(head).to_bytes(8, "little") + head + content))
        else:
            out.append((name, content))
    return zipped(out)


MODEL_FOLDER = Shape(_safetensors_parts, _safetensors)
"""A folder as a stored zip, in it a file of safetensors whose header is a part of its own."""
