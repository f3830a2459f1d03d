"""SUN RGB-D: objects by oriented box, less the floor, from the raw depth of four sensors.

Song, Lichtenberg, Xiao, "SUN RGB-D: A RGB-D Scene Understanding Benchmark Suite", CVPR 2015.

    SUNRGBDMeta3DBB_v2.mat             version 5; SUNRGBDMeta: a struct a frame, with
        depthpath, sensorType (kv1, kv2, xtion, realsense), K [3, 3], Rtilt [3, 3]
        groundtruth3DBB: structs with classname, basis [3, 3] (rows are the axes), coeffs [3] (half
                         the sizes, perhaps negative) and centroid [3], in metres
    SUNRGBDtoolbox/traintestSUNRGBD/allsplit.mat    alltrain, alltest: folders of the frames
    SUNRGBD/<sensor>/.../<frame>/depth/*.png        raw depth; depth_bfx/ has it filled in

Paths in the tables begin with a folder of the authors' machine; what follows its SUNRGBD/ counts.
`depthpath` is that of the filled depth: the raw one is the only PNG in the folder depth next to it
(its name may differ).

A depth pixel is a millimetre with its 16 bits rotated to the left by three. K counts pixels from 1.
The toolbox turns a pixel's point to (x, depth, -y), and Rtilt takes that to a frame with z up, in
which the boxes are; the camera is its origin.

What lies in an object's box and is not its floor is cut. A box is not a mask: a chair under a table
lies in the table's box, too, and what stands on a table is cut with it. Nor can it have holes: that
column of the manifest is 0.
"""

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import cv2
import numpy as np
from jaxtyping import Float

from qs3.datasets.cutting import Box, Fault, Piece, box_mask, cut
from qs3.datasets.depth_images import DepthImage, Pinhole
from qs3.datasets.frames import Cutter, FrameDataset, FrameTask, frame_task, load_mat
from qs3.store.meta import MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.settings import settings

META = "SUNRGBDMeta3DBB_v2.mat"
SPLITS = "SUNRGBDtoolbox/traintestSUNRGBD/allsplit.mat"
Sensor = Literal["kv1", "kv2", "xtion", "realsense"]

_ROOT = "SUNRGBD"
_SUN3D = "sun3ddata"  # its folders are rooms; those of the other parts are single frames
_SWAPPED = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""(x, y, z) of the camera to the toolbox's (x, z, -y)."""


class Frame(NamedTuple):
    """One entry of the table, counted from 1; `folder` is relative to the archive.

    `boxes` are the authors' words for the things in it, and their boxes in the frame with z up;
    None where the numbers are not those of a box: people drew thousands.
    """

    number: int
    sensor: str
    folder: PurePosixPath
    camera: Pinhole
    world_from_camera: Float[np.ndarray, "3 3"]
    boxes: tuple[tuple[str, Box | None], ...]


def read_frames(root: Path) -> list[Frame]:
    """All entries of the table of boxes."""
    path = root / META
    found = load_mat(path)
    with reading(path):
        entries = _listed(found["SUNRGBDMeta"])
        return [_frame(entry, number) for number, entry in enumerate(entries, start=1)]


def read_splits(root: Path, splits: str = SPLITS) -> dict[PurePosixPath, str]:
    """The split of each frame, by its folder: "train" or "test"."""
    path = root / splits
    found = load_mat(path)
    with reading(path):
        sides = (("alltrain", "train"), ("alltest", "test"))
        return {_inner(words): split for name, split in sides for words in _listed(found[name])}


def millimetres(rotated: np.ndarray) -> Float[np.ndarray, "h w"]:
    """[h, w] float64 depth in millimetres from pixels of 16 bits that were rotated."""
    assert np.asarray(rotated).dtype == np.uint16, "not a picture of 16 bits"
    return ((rotated >> np.uint16(3)) | (rotated << np.uint16(13))).astype(np.float64)


@settings
class SUNRGBD(FrameDataset):
    """See the module; conf/domain/sunrgbd.yaml explains its settings."""

    sensors: list[Sensor] = field(default_factory=lambda: list(get_args(Sensor)))
    splits: str = SPLITS

    made: ClassVar[MadeOf] = MadeOf(
        objects="real objects cut by their boxes from the raw depth of SUN RGB-D"
    )

    def files(self) -> Sequence[Path]:
        """See `FrameDataset`."""
        return [self.root / META, self.root / self.splits]

    def tasks(self) -> list[FrameTask]:
        """See `FrameDataset`; frames of the chosen sensors that are of a split."""
        splits = read_splits(self.root, self.splits)
        return [
            frame_task(one.number, split, _cluster(one, self.block), one.sensor, "published", one)
            for one in read_frames(self.root)
            if one.sensor in self.sensors and (split := splits.get(one.folder))
        ]

    def cutter(self) -> Cutter:
        """See `FrameDataset`."""

        def cut_frame(task: FrameTask) -> list[tuple[ManifestRow, np.ndarray]]:
            frame: Frame = task.known
            wanted = [(name, box) for name, box in frame.boxes if name in self.names]
            if not wanted:
                return []
            folder = self.root / Path(*frame.folder.parts) / "depth"
            with reading(folder):
                (path,) = folder.glob("*.png")
                depth_mm = millimetres(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            image = DepthImage(depth_mm / 1000.0, frame.camera, frame.world_from_camera)
            cuts = []
            for number, (name, box) in enumerate(wanted, start=1):
                if box is None:
                    nothing = np.zeros((0, 3), np.float32)
                    wrong = (Fault("box", "its numbers are not those of a box", True),)
                    piece = Piece(nothing, np.zeros(0, bool), 0, 1.0, faults=wrong)
                else:
                    mask = box_mask(image, box, self.rules)
                    piece = cut(image, mask, self.names[name], self.rules, edge_px=0)
                row = self.row_of(name, f"{frame.folder}, {name} {number}", piece)
                cuts.append((row, piece.points_m))
            return cuts

        return cut_frame


def _cluster(frame: Frame, block: int) -> str:
    """The room of a frame of SUN3D; else the block of frames in a row that it is one of."""
    parts = frame.folder.parts
    if _SUN3D in parts[:-1]:
        room = "-".join(parts[parts.index(_SUN3D) + 1 : -1]) or parts[-1]
        return f"{frame.sensor}_{room}"
    return f"{frame.sensor}_block{frame.number // block:05d}"


def _listed(value: Any) -> list[Any]:
    """A struct array or cell array as a list: one element comes alone, none as an empty array."""
    return list(np.ravel(value)) if isinstance(value, np.ndarray | list) else [value]


def _frame(entry: dict[str, Any], number: int) -> Frame:
    k = np.asarray(entry["K"], np.float64).reshape(3, 3)
    tilt = np.asarray(entry["Rtilt"], np.float64).reshape(3, 3)
    boxes = [one for one in _listed(entry.get("groundtruth3DBB", [])) if isinstance(one, dict)]
    return Frame(
        number,
        str(entry["sensorType"]),
        _inner(entry["depthpath"]).parent.parent,
        Pinhole(k[0, 0], k[1, 1], k[0, 2] - 1, k[1, 2] - 1),
        tilt @ _SWAPPED,
        tuple(map(_box, boxes)),
    )


def _box(entry: dict[str, Any]) -> tuple[str, Box | None]:
    """One of thousands that people drew: one that is not a box costs only itself."""
    name = str(entry.get("classname", ""))
    try:
        axes = np.asarray(entry["basis"], np.float64).reshape(3, 3)
        half = np.abs(np.asarray(entry["coeffs"], np.float64)).reshape(3)
        centre = np.asarray(entry["centroid"], np.float64).reshape(3)
    except (KeyError, TypeError, ValueError):
        return name, None
    good = np.allclose(axes @ axes.T, np.eye(3), atol=0.05) and np.isfinite([half, centre]).all()
    return name, Box(centre, axes, half) if good else None


def _inner(words: Any) -> PurePosixPath:
    """What follows SUNRGBD/ in a path of the authors' machine, with it."""
    parts = str(words).split("/")
    return PurePosixPath(*parts[parts.index(_ROOT) :])
