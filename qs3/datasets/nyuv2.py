"""NYU Depth V2: objects by instance from the raw depth of its 1,449 labelled frames (Kinect v1).

Silberman, Hoiem, Kohli, Fergus, "Indoor Segmentation and Support Inference from RGBD Images",
ECCV 2012. `nyu_depth_v2_labeled.mat` is MATLAB's version 7.3, that is HDF5 with all axes in
reverse order:

    rawDepths     float32 [N, W, H]  metres, projected onto the colour image and not filled in;
                                     0 where nothing was measured
    labels        uint16 [N, W, H]   number of the name from 1; 0: not labelled
    instances     uint8 [N, W, H]    counts the things of one name within a frame from 1
    names         cells of text      by the numbers of `labels`
    scenes        cells of text      the room of each frame, e.g. kitchen_0004

The raw depth lies in the colour camera's image, so its intrinsics are the colour camera's, from
camera_params.m of the authors' toolbox (there with pixels counted from 1). Depth is projected to
rows 45 to 471 and columns 41 to 601 at most (get_projection_mask.m), which is the border that cuts
an object off. `splits.mat` (MATLAB's version 5) holds trainNdxs and testNdxs, counted from 1.

An object is what carries one number of `instances` under one name; `cut` takes its pixels from
`rawDepths`, with the sensor's own holes and edges. Things of the names in `with_contents` get what
lies on them: the authors labelled a bookshelf's books apart from it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, Float

from qs3.datasets.cutting import cut
from qs3.datasets.depth_images import DepthImage, Pinhole, upright
from qs3.datasets.frames import Cutter, FrameDataset, FrameTask, frame_task, load_mat
from qs3.datasets.vertical import floor_up, planes_up
from qs3.errors import DataError
from qs3.store.meta import MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.progress import shown
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

CAMERA = Pinhole(518.857901, 519.469611, 325.582449 - 1, 253.736166 - 1)
"""The colour camera, whose image the depth lies in; (0, 0) is the first pixel's centre."""

AREA = (44, 471, 40, 601)
"""Rows from, to and columns from, to of the depth that was projected; of pictures of 640 x 480."""

_FARTHEST_M = 9.99


class LabelledFrames(AbstractContextManager["LabelledFrames"]):
    """The open .mat; a context manager. Images are read when they are asked for.

    Attributes:
        path: of the file.
        names: by number of label; names[0] is the first name, whose number is 1.
        scenes: the room of each frame; empty strings if the file does not have them.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self.path = path
        with reading(path):
            self._file: Any = h5py.File(path, "r")
            self._n, *self._shape = self._file["rawDepths"].shape
            self.names, self.scenes = self._words("names"), [""] * self._n
            if "scenes" in self._file:
                self.scenes = self._words("scenes")
            assert len(self.scenes) == self._n

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        """N, the frames."""
        return int(self._n)

    @property
    def area(self) -> tuple[int, int, int, int] | None:
        """Where depth was projected to; None if the pictures have not the published size."""
        return AREA if self._shape == [640, 480] else None

    def depth_m(self, frame: int) -> Float[np.ndarray, "h w"]:
        """[h, w] float64, 0 where nothing was measured (the toolbox cuts depths off at 10 m)."""
        depth = self.read("rawDepths", frame).astype(np.float64)
        return np.where(depth < _FARTHEST_M, depth, 0)

    def read(self, key: str, frame: int) -> np.ndarray:
        """[h, w] one image of the file; see the module."""
        with reading(self.path):
            found: np.ndarray = self._file[key][frame].T
            return found

    def _words(self, name: str) -> list[str]:
        """A cell array of text: references to arrays of letters."""
        cells = (self._file[reference] for reference in self._file[name][...].ravel())
        # Of an empty text the numbers are its size, 0 by 0.
        letters = ([] if c.attrs.get("MATLAB_empty", 0) else c[...].ravel(order="F") for c in cells)
        return ["".join(map(chr, some)) for some in letters]


def read_splits(path: Path, frames: int) -> list[str]:
    """The split of each frame: "train", "test", or "" if it is in neither list."""
    found = load_mat(path)
    splits = [""] * frames
    with reading(path):
        for name, split in (("trainNdxs", "train"), ("testNdxs", "test")):
            for number in np.ravel(found[name]).astype(np.int64).tolist():
                assert 1 <= number <= frames, f"frame {number} of {frames}"
                assert not splits[number - 1], f"frame {number} twice"
                splits[number - 1] = split
    return splits


@settings
class NYUv2(FrameDataset):
    """See the module; conf/domain/nyuv2.yaml explains its settings."""

    file: str = "nyu_depth_v2_labeled.mat"
    splits: str = "splits.mat"
    with_contents: dict[str, list[str]] = field(default_factory=dict)

    made: ClassVar[MadeOf] = MadeOf(
        objects="real objects cut from the raw depth of NYU Depth V2 (Kinect v1)"
    )

    def files(self) -> Sequence[Path]:
        """See `FrameDataset`."""
        return [self.root / self.file, self.root / self.splits]

    def tasks(self) -> list[FrameTask]:
        """See `FrameDataset`; finds the vertical of each frame on the way.

        Frames without a vertical are left out, and so are those of neither split.
        """
        found, lost = [], []
        with LabelledFrames(self.root / self.file) as frames:
            splits = read_splits(self.root / self.splits, len(frames))
            chosen = [i for i, split in enumerate(splits) if split]
            for i in shown(chosen, "looking for floors"):
                way, up = _vertical(frames, i)
                room = re.sub(r"[^\w-]", "-", frames.scenes[i])
                room = re.sub(r"(?<=\d)[a-z]$", "", room)  # 0001d is a recording of 0001
                room = room or f"block{i // self.block:04d}"
                if up is None:
                    lost.append(i + 1)
                    continue
                found.append(frame_task(i + 1, splits[i], room, "kinect_v1", way, upright(up)))
        if lost:
            log.warning("%s: frames without a vertical are left out: %s", self.root, lost)
        return found

    def cutter(self) -> Cutter:
        """See `FrameDataset`."""
        frames = LabelledFrames(self.root / self.file)

        def cut_frame(task: FrameTask) -> list[tuple[ManifestRow, np.ndarray]]:
            index = task.number - 1
            image = DepthImage(frames.depth_m(index), CAMERA, task.known, frames.area)
            labels, instances = frames.read("labels", index), frames.read("instances", index)
            cuts = []
            for number in np.unique(labels[labels > 0]).tolist():
                if number > len(frames.names):
                    raise DataError(f"{frames.path}, frame {task.number}: label without a name")
                name = frames.names[number - 1]
                if name not in self.names:
                    continue
                same = labels == number
                for instance in np.unique(instances[same & (instances > 0)]).tolist():
                    mask = same & (instances == instance)
                    mask |= self._contents(name, mask, labels, frames.names)
                    piece = cut(image, mask, self.names[name], self.rules)
                    origin = f"{self.file}, frame {task.number}, {name} {instance}"
                    cuts.append((self.row_of(name, origin, piece), piece.points_m))
            return cuts

        return cut_frame

    def _contents(
        self, name: str, mask: np.ndarray, labels: np.ndarray, names: Sequence[str]
    ) -> Bool[np.ndarray, "h w"]:
        """[h, w] pixels of what belongs to the thing and lies within its convex outline."""
        wanted = self.with_contents.get(name, ())
        numbers = [i + 1 for i, other in enumerate(names) if other in wanted]
        others = np.isin(labels, numbers)
        if not others.any():
            return others
        hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
        inside = np.zeros(mask.shape, np.uint8)
        cv2.fillConvexPoly(inside, hull, (1,))
        return others & (inside == 1)


def _vertical(frames: LabelledFrames, frame: int) -> tuple[str, np.ndarray | None]:
    """How the vertical of a frame was found, and up in its camera."""
    depth_m, floor = frames.depth_m(frame), np.zeros(0, bool)
    if "floor" in frames.names:
        floor = frames.read("labels", frame) == frames.names.index("floor") + 1
    if floor.any() and (up := floor_up(depth_m, CAMERA, floor)) is not None:
        return "floor", up
    return "planes", planes_up(depth_m, CAMERA)
