"""NYU Depth V2: objects by instance from the raw depth of its 1,449 labelled frames (Kinect v1).

The files are described in `qs3.datasets.frames.nyuv2`. An object is what carries one number of
`instances` under one name; its pixels are cut by `qs3.datasets.frames.cutting` from `rawDepths`,
with
the sensor's own holes and edges. Things of the names in `with_contents` get what lies on them: the
authors labelled a bookshelf's books apart from it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from qs3.config.checks import check_choice
from qs3.datasets.frames.cutting import cut
from qs3.datasets.frames.images import DepthImage, Pinhole, upright
from qs3.datasets.frames.nyuv2 import CAMERA, LabelledFrames, read_splits
from qs3.datasets.frames.rules import Rules
from qs3.datasets.frames.vertical import Mounting, angle_deg, floor_up, mounting, planes_up
from qs3.datasets.importers.frame_importer import Cut, Cutter, FrameImporter, FrameTask
from qs3.errors import ConfigError, DataError
from qs3.store.meta import MadeOf
from qs3.utils.plural import counted
from qs3.utils.progress import progress_bar

log = logging.getLogger(__name__)

VERTICALS = ("floor", "accelerometer", "planes")
_FLOOR = "floor"
_MOST_MOUNTING_DEG = 5.0  # readings that agree worse with the floors say nothing
_MOST_APART_DEG = 10.0  # a floor farther off its reading is none: a rug on stairs, a mirror


@dataclass(frozen=True)
class NYUv2(FrameImporter):
    """See the module.

    Attributes:
        file, splits: names of nyu_depth_v2_labeled.mat and splits.mat in the folder.
        vertical: how up is found, the first way that gives one; see `qs3.datasets.frames.vertical`.
        with_contents: name -> names of things that belong to it where they lie within its outline.
        camera: intrinsics in place of the published ones: fx_px, fy_px, cx_px, cy_px.
    """

    file: str = "nyu_depth_v2_labeled.mat"
    splits: str = "splits.mat"
    vertical: Sequence[str] = VERTICALS
    with_contents: Mapping[str, Sequence[str]] = field(default_factory=dict)
    camera: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for way in self.vertical:
            check_choice("published.vertical", way, VERTICALS)
        if not self.vertical:
            raise ConfigError(f"published.vertical is empty; give some of {', '.join(VERTICALS)}")
        object.__setattr__(self, "vertical", list(self.vertical))
        contents = {name: list(others) for name, others in dict(self.with_contents).items()}
        object.__setattr__(self, "with_contents", contents)
        object.__setattr__(self, "camera", dict(self.camera) if self.camera else None)
        self.pinhole()

    def pinhole(self) -> Pinhole:
        """The camera whose image the depth lies in."""
        try:
            return Pinhole(**self.camera) if self.camera else CAMERA
        except (TypeError, DataError) as error:
            raise ConfigError(f"published.camera: {error}") from error

    def files(self) -> Mapping[str, Path]:
        """See `FrameImporter`."""
        return {
            "the labelled dataset": self.root / self.file,
            "its splits": self.root / self.splits,
        }

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects="real objects cut from the raw depth of NYU Depth V2 (Kinect v1)")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [
            f"{self.root / self.file}   (the labelled dataset, 3.0 GB)",
            f"{self.root / self.splits}   (trainNdxs and testNdxs)",
        ]

    def tasks(self) -> list[FrameTask]:
        """See `FrameImporter`; finds the vertical of each frame on the way.

        Frames whose vertical nobody can tell are left out, and so are those of neither split.
        """
        with LabelledFrames(self.root / self.file) as frames:
            splits = read_splits(self.root / self.splits, len(frames))
            ups = self._verticals(frames, splits)
            lost = [i + 1 for i in ups if ups[i] is None]
            if lost:
                log.warning(
                    "%s: %s left out, since nobody can tell what is up, first %d",
                    frames.path,
                    counted(len(lost), "frame is", "frames are"),
                    lost[0],
                )
            return [
                FrameTask(
                    i + 1,
                    splits[i],
                    _room(frames.scenes[i]) or f"block{i // self.block:04d}",
                    "kinect_v1",
                    found[0],
                    upright(found[1]).tolist(),
                )
                for i, found in ups.items()
                if found is not None
            ]

    def cutter(self) -> Cutter:
        """See `FrameImporter`."""
        frames, rules = LabelledFrames(self.root / self.file), Rules.of(self.rules)

        def cut_frame(task: FrameTask) -> list[Cut]:
            index = task.number - 1
            turn = np.array(task.world_from_camera)
            image = DepthImage(frames.depth_m(index), self.pinhole(), turn, frames.area)
            labels, instances = frames.labels(index), frames.instances(index)
            cuts = []
            for number in np.unique(labels[labels > 0]).tolist():
                name = frames.names[number - 1]
                if name not in self.names:
                    continue
                same = labels == number
                for instance in np.unique(instances[same & (instances > 0)]).tolist():
                    mask = same & (instances == instance)
                    mask |= self._contents(name, mask, labels, frames.names)
                    cls = self.names[name]
                    piece = cut(image, mask, cls, rules)
                    origin = f"{self.file}, frame {task.number}, {name} {instance}"
                    cuts.append(Cut(cls, name, origin, piece))
            return cuts

        return cut_frame

    def _contents(
        self, name: str, mask: np.ndarray, labels: np.ndarray, names: Sequence[str]
    ) -> np.ndarray:
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

    def _verticals(
        self, frames: LabelledFrames, splits: Sequence[str]
    ) -> dict[int, tuple[str, np.ndarray] | None]:
        """How the vertical of each frame of a split was found, and up in its camera."""
        chosen = [i for i, split in enumerate(splits) if split]
        floors: dict[int, np.ndarray] = {}
        if {*self.vertical} & {_FLOOR, "accelerometer"}:  # whose mounting the floors tell
            floors = self._floors(frames, chosen)
        seat = _checked_mounting(frames, floors) if "accelerometer" in self.vertical else None
        found: dict[int, tuple[str, np.ndarray] | None] = {}
        for i in chosen:
            found[i] = None
            for way in self.vertical:
                up = self._up(way, frames, i, floors, seat)
                if up is not None:
                    found[i] = way, up
                    break
        return found

    def _floors(self, frames: LabelledFrames, chosen: Sequence[int]) -> dict[int, np.ndarray]:
        if _FLOOR not in frames.names:
            return {}
        number, found = frames.names.index(_FLOOR) + 1, {}
        with progress_bar("looking for floors", total=len(chosen)) as advance:
            for i in chosen:
                floor = frames.labels(i) == number
                up = floor_up(frames.depth_m(i), self.pinhole(), floor) if floor.any() else None
                if up is not None:
                    found[i] = up
                advance()
        return found

    def _up(
        self,
        way: str,
        frames: LabelledFrames,
        frame: int,
        floors: Mapping[int, np.ndarray],
        seat: Mounting | None,
    ) -> np.ndarray | None:
        """Up by one way; None if it does not tell."""
        reading = seat.up(frames.accelerations[frame]) if seat else None
        if way == "accelerometer":
            return reading
        if way == "planes":
            return planes_up(frames.depth_m(frame), self.pinhole())
        up = floors.get(frame)
        apart = up is not None and reading is not None and angle_deg(up, reading)
        return None if apart and apart > _MOST_APART_DEG else up


def _room(scene: str) -> str:
    """The room in a scene's name: bookstore_0001d is a recording of bookstore_0001."""
    return re.sub(r"(?<=\d)[a-z]$", "", re.sub(r"[^\w-]", "-", scene))


def _checked_mounting(frames: LabelledFrames, floors: Mapping[int, np.ndarray]) -> Mounting | None:
    """How the accelerometer sits in the camera, if its readings agree with the floors."""
    if not floors:
        return None
    seat = mounting(frames.accelerations[list(floors)], np.stack(list(floors.values())))
    if seat is None:
        log.info("%s: too few accelerometer readings beside a floor", frames.path)
    elif seat.error_deg > _MOST_MOUNTING_DEG:
        log.warning(
            "%s: accelerometer readings are %.1f degrees off the floors (median of %d frames) and "
            "are not used",
            frames.path,
            seat.error_deg,
            seat.frames,
        )
        return None
    else:
        log.info(
            "%s: accelerometer and floors agree within %.1f degrees (median of %d frames)",
            frames.path,
            seat.error_deg,
            seat.frames,
        )
    return seat
