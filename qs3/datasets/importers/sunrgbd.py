"""SUN RGB-D: objects by oriented box, less the floor, from the raw depth of four sensors.

The archive is described in `qs3.datasets.frames.sunrgbd`. What lies in an object's box and is not
its
floor is cut by `qs3.datasets.frames.cutting`. A box is not a mask: a chair under a table lies in
the
table's box, too, and what stands on a table is cut with it. Nor can it have holes: that column of
the manifest is 0.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.config.checks import check_choice
from qs3.datasets.frames.cutting import Piece, box_mask, cut
from qs3.datasets.frames.rules import Rules
from qs3.datasets.frames.sunrgbd import (
    META,
    SENSORS,
    SPLITS,
    Frame,
    open_image,
    read_frames,
    read_splits,
)
from qs3.datasets.importers.frame_importer import Cut, Cutter, FrameImporter, FrameTask
from qs3.errors import ConfigError
from qs3.store.meta import MadeOf
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

_NAMED = 12  # other names that the log shows
_SUN3D = "sun3ddata"  # its folders are rooms; those of the other parts are single frames


@dataclass(frozen=True)
class SUNRGBD(FrameImporter):
    """See the module.

    Attributes:
        sensors: whose frames are cut.
        splits: allsplit.mat, relative to the folder.
    """

    sensors: Sequence[str] = SENSORS
    splits: str = SPLITS

    def __post_init__(self) -> None:
        super().__post_init__()
        for sensor in self.sensors:
            check_choice("published.sensors", sensor, SENSORS)
        if not self.sensors or len({*self.sensors}) < len(self.sensors):
            raise ConfigError(f"published.sensors={list(self.sensors)}: empty, or one twice")
        object.__setattr__(self, "sensors", list(self.sensors))

    def files(self) -> Mapping[str, Path]:
        """See `FrameImporter`."""
        return {"the boxes": self.root / META, "the splits": self.root / self.splits}

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects="real objects cut by their boxes from the raw depth of SUN RGB-D")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [
            f"{self.root / META}   (boxes)",
            f"{self.root / self.splits}   (official splits)",
            f"{self.root}/SUNRGBD/<sensor>/.../<frame>/depth/*.png   (raw depth)",
        ]

    def tasks(self) -> list[FrameTask]:
        """See `FrameImporter`; frames of the chosen sensors that are of a split."""
        frames = [one for one in read_frames(self.root) if one.sensor in self.sensors]
        splits = read_splits(self.root, self.splits)
        known = [one for one in frames if one.folder in splits]
        if len(known) < len(frames):
            strangers = counted(len(frames) - len(known), "frame")
            log.info("%s in neither split left out", strangers)
        others = Counter(
            box.name for one in known for box in one.boxes if box.name not in self.names
        )
        if others:
            log.info(
                "boxes of other names are left out: %s",
                ", ".join(f"{name} {count}" for name, count in others.most_common(_NAMED)),
            )
        return [
            FrameTask(
                one.number, splits[one.folder], _cluster(one, self.block), one.sensor, "published"
            )
            for one in known
        ]

    def cutter(self) -> Cutter:
        """See `FrameImporter`."""
        rules = Rules.of(self.rules)
        frames = {one.number: one for one in read_frames(self.root)}

        def cut_frame(task: FrameTask) -> list[Cut]:
            frame = frames[task.number]
            wanted = [box for box in frame.boxes if box.name in self.names]
            if not wanted:
                return []
            image = open_image(self.root, frame)
            where = str(frame.folder)
            cuts = []
            for number, one in enumerate(wanted):
                cls = self.names[one.name]
                origin = f"{where}, {one.name} {number + 1}"
                if one.box is None:
                    nothing = np.zeros((0, 3), np.float32)
                    piece = Piece(nothing, np.zeros(0, bool), 0, 1.0, why=one.why, refused=True)
                else:
                    piece = cut(image, box_mask(image, one.box, rules), cls, rules, edge_px=0)
                cuts.append(Cut(cls, one.name, origin, piece))
            return cuts

        return cut_frame


def _cluster(frame: Frame, block: int) -> str:
    """The room of a frame of SUN3D; else the block of frames in a row that it is one of."""
    parts = frame.folder.parts
    if _SUN3D in parts[:-1]:
        room = "-".join(parts[parts.index(_SUN3D) + 1 : -1]) or parts[-1]
        return f"{frame.sensor}_{room}"
    return f"{frame.sensor}_block{frame.number // block:05d}"
