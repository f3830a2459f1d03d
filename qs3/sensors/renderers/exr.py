"""Reading the EXR files that Blender writes here."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from qs3.errors import RenderError


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Channels [h, w] float32 by full name of an EXR file as Blender writes it here.

    That is scan lines, float32, not compressed. Neither bpy nor OpenCV hands out the channels of a
    multilayer file.
    """
    data = path.read_bytes()
    if data[:4] != b"\x76\x2f\x31\x01":
        raise RenderError(f"{path}: not an EXR file")
    attributes: dict[str, bytes] = {}
    at = 8
    while data[at]:
        name_end = data.index(0, at)
        type_end = data.index(0, name_end + 1)
        size = int.from_bytes(data[type_end + 1 : type_end + 5], "little")
        start = type_end + 5
        attributes[data[at:name_end].decode()] = data[start : start + size]
        at = start + size
    if attributes["compression"] != b"\0":
        raise RenderError(f"{path}: the EXR file is compressed")
    x0, y0, x1, y1 = np.frombuffer(attributes["dataWindow"], "<i4")
    width, height = int(x1 - x0) + 1, int(y1 - y0) + 1

    names, listing, spot = [], attributes["channels"], 0
    while listing[spot]:
        name_end = listing.index(0, spot)
        if listing[name_end + 1 : name_end + 5] != b"\2\0\0\0":
            raise RenderError(f"{path}: channels are not float32")
        names.append(listing[spot:name_end].decode())
        spot = name_end + 17  # type, linearity and sampling: 16 bytes
    # A line: its number, its size, then all of channel 0, all of channel 1, ...
    line = np.dtype([("y", "<i4"), ("size", "<i4"), ("value", "<f4", (len(names), width))])
    first = at + 1 + 8 * height  # behind the table of line offsets
    lines = np.frombuffer(data, line, count=height, offset=first)
    return {name: lines["value"][:, i] for i, name in enumerate(names)}
