"""Infrared pictures in files: which belong together, and what their numbers mean."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from qs3.calibration.fit.frames import read_frame
from qs3.calibration.fit.infrared import Pictures
from qs3.errors import DataError, MissingDataError
from qs3.utils.pictures import png_bytes, read_png
from qs3.utils.text_table import printable

log = logging.getLogger(__name__)

NAMES = "SCENE_left.png, SCENE_right.png, SCENE_off.png, SCENE_depth.png or .npy"

_FILE = re.compile(
    r"(?P<scene>.+?)_(?P<what>left|right|off|depth)(_?\d+)?\.(png|npy)", re.IGNORECASE
)
_MOST = 2_000  # pictures of a folder
_FRAMES = 64  # of a scene and kind


def read_pictures(folder: Path, unit: str | None = None) -> list[Pictures]:
    """The scenes of a folder, by name.

    Files are called SCENE_left.png, SCENE_right.png, SCENE_off.png (the left camera with the
    projector off, at the same exposure) and SCENE_depth.png or .npy (of the left camera); several
    frames of a still scene have numbers, SCENE_left_0.png; the first 64 are read. Names may be in
    any case. Pictures have 8 bits, or 16 that are used to the full.

    Args:
        folder: with the files; others in it are left alone.
        unit: of depths, see `read_frame`.

    Raises:
        MissingDataError: there is no such folder, or no left picture in it.
        DataError: a file cannot be read, is of another size than the scene's first, or there are
            more than 2000.
    """
    if not folder.is_dir():
        raise MissingDataError(f"images={folder}: there is no such folder")
    found: dict[str, dict[str, list[Path]]] = {}
    for path in sorted(folder.iterdir()):
        if (match := _FILE.fullmatch(path.name)) is not None:
            kinds = found.setdefault(match["scene"], {})
            kinds.setdefault(match["what"].lower(), []).append(path)
    count = sum(len(paths) for kinds in found.values() for paths in kinds.values())
    if count > _MOST:
        raise DataError(f"images={folder} holds {count} pictures; at most {_MOST} are read")
    scenes = [_scene(name, kinds, unit) for name, kinds in sorted(found.items()) if "left" in kinds]
    if not scenes:
        raise MissingDataError(f"images={folder} holds no SCENE_left.png; files are called {NAMES}")
    return scenes


def _scene(name: str, kinds: dict[str, list[Path]], unit: str | None) -> Pictures:
    for what, paths in kinds.items():
        if what != "depth" and len(paths) > _FRAMES:
            words = "%s_%s has %d frames: the first %d by name are read"
            log.warning(words, printable(name), what, len(paths), _FRAMES)
    left, right, off = (
        [_grey(path) for path in kinds.get(what, [])[:_FRAMES]] for what in ("left", "right", "off")
    )
    depth = None
    if "depth" in kinds:
        depth = read_frame(kinds["depth"][0], unit).depth_m
        if depth.shape != left[0].shape:
            raise DataError(
                f"{kinds['depth'][0]} has {depth.shape} pixels, the left picture {left[0].shape}: "
                "the depth must be the left camera's, at its full size"
            )
    for path, image in zip(kinds.get("right", []), right, strict=False):
        if image.shape != left[0].shape:
            raise DataError(f"{path} has {image.shape} pixels, the left picture {left[0].shape}")
    return Pictures(name, left, right, off, depth)


def _grey(path: Path) -> np.ndarray:
    """[h, w] float64, 0..255."""
    if path.suffix.lower() != ".png":
        raise DataError(f"{path}: pictures are .png files")
    image = read_png(png_bytes(path), str(path))
    return image.astype(np.float64) / (257.0 if image.dtype == np.uint16 else 1.0)
