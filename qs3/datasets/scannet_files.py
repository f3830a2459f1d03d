"""ScanNet's files: recordings, zips of masks, labels, and which scenes there are.

Facts were taken from its public tools (github.com/ScanNet/ScanNet: SensReader, AnnotationTools,
BenchmarkScripts) and README; PointDA-10's names from github.com/canqin001/PointDAN,
data_extraction/ScanNet.

`.sens`, format version 4: little endian, without padding: version uint32, sensor name (uint64
length, bytes), four 4x4 float32 matrices (intrinsics and extrinsics of the colour camera, then of
the depth camera), colour and depth compression int32, colour width and height, depth width and
height uint32, depth shift float32 (units a metre), number of frames uint64; each frame:
camera-to-world 4x4 float32, time stamps of colour and depth uint64, bytes of colour and of depth
uint64, then those bytes. Frames of an inertial sensor follow; they are not read.

Conventions of SensReader: matrices are row-major; the centre of the top left pixel is at (0, 0); an
extrinsic matrix takes its camera's coordinates to the base frame of the device (typically the
colour camera's, whose matrix is then the identity); camera-to-world belongs to the depth camera,
and a lost frame has -inf everywhere in it. Colour and depth of the published scans are said to be
aligned already (ScanNet issues 2 and 92); whatever the file holds is used.

`<scene>_2d-instance-filt.zip` holds `instance-filt/<frame>.png` of 8 bits, and
`<scene>_2d-label-filt.zip` `label-filt/<frame>.png` of 16 bits; frames count from 0 as in the
`.sens`, and an image has the colour camera's resolution. `<scene>.aggregation.json` lists the
objects, each with an `objectId` (from 0) and a label in the annotators' words.
`scannetv2-labels.combined.tsv` maps these words (`raw_category`) to tidied ones (`category`:
plurals, misspellings and synonyms gone) and to a number (`id`). A pixel of the instance image is
`objectId` + 1 and one of the label image the `id` of the object's label; 0 is unannotated in both.

PointDA-10 takes the objects whose label is one of ten names, exactly: `NAMES`. So a "bookshelf" is
none of its shelves and a "sofa" only a couch if the label map says so.
"""

from __future__ import annotations

import csv
import json
import logging
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt

from qs3.classes import ALIASES, CLASSES
from qs3.utils.files import reading

log = logging.getLogger(__name__)

NAMES: tuple[str, ...] = (
    "bathtub", "bed", "shelf", "cabinet", "chair", "lamp", "monitor", "plant", "couch", "table",
)  # fmt: skip
"""ScanNet's names of the ten classes, in the order of PointDA-10 (PointDAN's class list)."""

INSTANCES, LABELS = "instance-filt", "label-filt"

SUFFIXES: tuple[str, ...] = (
    ".sens", f"_2d-{INSTANCES}.zip", f"_2d-{LABELS}.zip", ".aggregation.json",
)  # fmt: skip
"""Endings of the files of a scene, after its name."""

_CLASS_OF = {name: ALIASES.get(name, name) for name in NAMES}
_SCENE = re.compile(r"scene\d{4}_\d{2}")
_START, _HEADER, _FRAME = struct.Struct("<IQ"), struct.Struct("<64f2i4IfQ"), struct.Struct("<16f4Q")
_VERSION, _ZLIB = 4, 1
_RIGID = 1e-2  # of a rotation's entries; stored as float32, they are about 1e-6 off


@dataclass(frozen=True, eq=False)
class SensHeader:
    """What holds for all frames.

    Attributes:
        colour_intrinsics, depth_intrinsics: [3, 3] float64, px; last row (0, 0, 1).
        colour_from_depth: [4, 4] float64 coordinates in the depth camera to those in the colour
            camera, by their extrinsics.
        colour_px, depth_px: width and height.
        packed: depth is compressed by zlib; else raw (both of uint16).
        depth_shift: depth units a metre.
        frames: how many there are.
    """

    colour_intrinsics: Float[np.ndarray, "3 3"]
    depth_intrinsics: Float[np.ndarray, "3 3"]
    colour_from_depth: Float[np.ndarray, "4 4"]
    colour_px: tuple[int, int]
    depth_px: tuple[int, int]
    packed: bool
    depth_shift: float
    frames: int


class SensFile(AbstractContextManager["SensFile"]):
    """An open recording; a context manager. DataError if it is not a recording or broken off.

    Opening it reads the header and, skipping the images, every frame's pose; images are read when
    they are asked for.

    Attributes:
        header: what holds for all frames.
        poses: [frames, 4, 4] float64 world_from_depth as stored; a lost frame's is not rigid.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading(path), ExitStack() as stack:
            self._file = stack.enter_context(open(path, "rb"))
            self.header = self._read_header()
            self.poses = np.empty((self.header.frames, 4, 4))
            self._depth_at = []
            for frame in range(self.header.frames):
                *pose, _, _, colour, depth = _FRAME.unpack(self._file.read(_FRAME.size))
                self.poses[frame] = np.reshape(pose, (4, 4))
                self._depth_at.append((self._file.tell() + colour, depth))
                self._file.seek(colour + depth, 1)
            assert self._file.tell() <= path.stat().st_size, "it is broken off; download it again"
            stack.pop_all()  # closed by __exit__

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def depth_m(self, frame: int) -> Float[np.ndarray, "h w"]:
        """[h, w] float32 depth along the optical axis in metres, 0 where nothing was measured."""
        (offset, length), (width, height) = self._depth_at[frame], self.header.depth_px
        if length == 0:  # as the format's own tools write a frame without depth
            return np.zeros((height, width), dtype=np.float32)
        with reading(f"{self.path}, frame {frame}"):
            self._file.seek(offset)
            data = self._file.read(length)
            data = zlib.decompress(data) if self.header.packed else data
            raw = np.frombuffer(data, dtype="<u2").reshape(height, width)
        return raw.astype(np.float32) / np.float32(self.header.depth_shift)

    def _read_header(self) -> SensHeader:
        version, length = _START.unpack(self._file.read(_START.size))
        assert version == _VERSION, f"version {version}, only {_VERSION} is known"
        self._file.seek(length, 1)  # the sensor's name
        values = _HEADER.unpack(self._file.read(_HEADER.size))
        colour_k, colour, depth_k, depth = np.array(values[:64], np.float64).reshape(4, 4, 4)
        _, packed, colour_w, colour_h, depth_w, depth_h, shift, frames = values[64:]
        colour_k, depth_k = colour_k[:3, :3].copy(), depth_k[:3, :3].copy()
        for k, extrinsic in ((colour_k, colour), (depth_k, depth)):
            good = k[0, 0] > 0 and k[1, 1] > 0 and np.isfinite(k).all() and is_rigid(extrinsic)
            assert good, "not matrices of a camera"
        assert packed in (0, _ZLIB), "its depth is in Occipital's compression"
        assert 1 <= shift < np.inf, f"a depth shift of {shift}"  # 1000: millimetres
        return SensHeader(
            colour_k,
            depth_k,
            np.linalg.inv(colour) @ depth,
            (colour_w, colour_h),
            (depth_w, depth_h),
            packed == _ZLIB,
            shift,
            frames,
        )


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a matrix is finite, a proper rotation, and a shift."""
    if not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    near = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_RIGID)
    last_row = np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=_RIGID)
    return bool(near and last_row and np.linalg.det(rotation) > 0)


class MaskArchive(AbstractContextManager["MaskArchive"]):
    """An open zip of masks, of the folder `INSTANCES` or `LABELS`; a context manager.

    Attributes:
        frames: that have a mask.
    """

    def __init__(self, path: Path, folder: str) -> None:
        self.path = path
        pattern = re.compile(rf"(?:[\w-]+/)?{re.escape(folder)}/(\d+)\.png")
        with reading(path):
            self._zip = zipfile.ZipFile(path)
            named = [(pattern.fullmatch(name), name) for name in self._zip.namelist()]
            self._members = {int(match[1]): name for match, name in named if match}
            assert self._members, f"it has no {folder}/<frame>.png"
        self.frames = frozenset(self._members)

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def read(self, frame: int) -> UInt[np.ndarray, "h w"]:
        """The mask of a frame; DataError if there is none."""
        with reading(f"{self.path}, frame {frame}"):
            data = np.frombuffer(self._zip.read(self._members[frame]), dtype=np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            assert np.ndim(image) == 2, "not a grey picture"
        return image


class LabelMap(NamedTuple):
    """Annotators' words, and numbers in a label mask, to the ten classes; others are left out."""

    class_of_label: Mapping[str, str]
    class_of_id: Mapping[int, str]


class Labelled(NamedTuple):
    """An object of one of the ten classes, with the annotators' word.

    Its mask's pixels are `object_id` + 1, the `objectId` of the aggregation.
    """

    object_id: int
    label: str
    cls: str


def read_label_map(path: Path) -> LabelMap:
    """Read scannetv2-labels.combined.tsv."""
    by_label, by_id = {}, {}
    with reading(path):
        lines = path.read_text(errors="replace").splitlines()
        for row in csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE):
            if cls := _CLASS_OF.get(row["category"].strip()):
                by_label[row["raw_category"].strip()] = cls
                by_id[int(row["id"])] = cls
        absent = sorted(set(CLASSES) - set(by_label.values()))
        assert not absent, f"no label of the classes {', '.join(absent)}"
    return LabelMap(by_label, by_id)


def read_objects(path: Path, label_map: LabelMap) -> list[Labelled]:
    """The objects of the ten classes in an aggregation.json, by `objectId`.

    One that has labels of different classes is left out.
    """
    found: dict[int, tuple[str, str | None]] = {}
    torn = set()
    with reading(path):
        for group in json.loads(path.read_text())["segGroups"]:
            number, label = int(group["objectId"]), group["label"].strip()
            cls = label_map.class_of_label.get(label)
            if found.setdefault(number, (label, cls))[1] != cls:
                torn.add(number)
    if torn:
        log.warning("%s: objects with labels of two classes: %s", path, sorted(torn))
    return [
        Labelled(number, label, cls)
        for number, (label, cls) in sorted(found.items())
        if cls is not None and number not in torn
    ]


def read_scene_list(path: Path) -> list[str]:
    """The scenes of scannetv2_train.txt or scannetv2_val.txt, one a line."""
    with reading(path):
        scenes = path.read_text().split()
        assert all(map(_SCENE.fullmatch, scenes or [""])), "a line is like scene0000_00"
    return scenes
