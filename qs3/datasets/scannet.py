"""DepthScanNet10 from raw ScanNet: the objects of ten classes as the depth camera measured them.

The paper (section 4, "Benchmarking Data") describes the dataset and no code for it was released.
What is fixed there: instance masks crop the depth images, only crops of more than 1,000 points
are kept, those of 10 viewpoints are fused, and 2,048 points are kept; scenes and split are those
of PointDA-10's ScanNet10.

Each recording is passed over twice, with one frame in memory: the first pass finds which frames
show enough of which object, and from where; the second crops the chosen ones.

Masks have the colour camera's view. A depth pixel is back-projected with the depth intrinsics,
taken to the colour camera by the extrinsics, and projected with the colour intrinsics, scaled to
the mask's resolution. What the colour camera cannot see, because something nearer hides it from
there and not from the depth camera, gets no mask pixel: it would get the label of what hides it.
"""

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import cv2
import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float, Int, UInt

from qs3.datasets.frames import CutDataset, Cutter, FrameTask
from qs3.datasets.scannet_files import (
    INSTANCES,
    LABELS,
    SUFFIXES,
    Labelled,
    LabelMap,
    MaskArchive,
    SensFile,
    SensHeader,
    is_rigid,
    read_label_map,
    read_objects,
    read_scene_list,
)
from qs3.errors import DataError
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.store.meta import MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.settings import Count, settings

log = logging.getLogger(__name__)

NEAR_M, FAR_M = 0.1, 10.0
"""Depths outside are left out."""

_MARGIN_PX = 1  # pixels around a mask's pixel that must show the same object, see `agreed`
_FARTHER = 0.05  # of the depth: surfaces that differ by more are a nearer and a farther one
# A cell of the nearest-surface map, in depth pixels: each cell of a visible surface gets a sample.
_CELL_DEPTH_PX = 2.0
_SAME_PLACE_M = 1e-6


@settings
class ScanNet(CutDataset):
    """Raw ScanNet: a folder of scenes; see the module and `qs3.datasets.scannet_files`.

    Attributes:
        labels: scannetv2-labels.combined.tsv, in the folder or by its whole path.
        train, val: the lists of scenes, likewise; the second is the split "test".
        min_points: a frame counts if it shows more points of the object than this.
        views: frames fused, far from each other in direction; fewer if there are fewer.
        stride: look at every n-th frame only; 10 takes a tenth of the time.
    """

    labels: str = "scannetv2-labels.combined.tsv"
    train: str = "scannetv2_train.txt"
    val: str = "scannetv2_val.txt"
    min_points: Annotated[int, Ge(0)] = 1000
    views: Count = 10
    stride: Count = 1

    recorded: ClassVar[str] = "extraction"
    made: ClassVar[MadeOf] = MadeOf(objects="ScanNet's raw depth, cropped by its masks here")

    def files(self) -> Sequence[Path]:
        """See `CutDataset`."""
        return [self.root / name for name in (self.labels, self.train, self.val)]

    def tasks(self) -> list[FrameTask]:
        """See `CutDataset`: the scenes of the lists that are there."""
        _, train, val = self.files()
        split_of = dict.fromkeys(read_scene_list(train), "train")
        split_of |= dict.fromkeys(read_scene_list(val), "test")
        folders = [self.root / scene for scene in sorted(split_of)]
        there = [folder for folder in folders if folder.is_dir()]
        log.info("scenes that are there: %d of the lists' %d", len(there), len(folders))
        # Another size means another file.
        sizes = [sum(p.stat().st_size for p in _files(at) if p.is_file()) for at in there]
        return [
            FrameTask(
                f"{at.name}_{size}", at.name, split_of[at.name], number, "structure", "given", at
            )
            for number, (at, size) in enumerate(zip(there, sizes, strict=True))
        ]

    def cutter(self) -> Cutter:
        """See `CutDataset`."""
        label_map = read_label_map(self.root / self.labels)
        return lambda task: _extract(self, task, label_map)


def _files(scene: Path) -> list[Path]:
    """The recording, the masks of instances, those of labels, and the list of objects."""
    return [scene / f"{scene.name}{suffix}" for suffix in SUFFIXES]


def _extract(
    data: ScanNet, task: FrameTask, label_map: LabelMap
) -> list[tuple[ManifestRow, np.ndarray]]:
    """The objects of a scene: points in the scene's world, metres, z up."""
    sens, instances, labels, aggregation = _files(task.known)
    labelled = read_objects(aggregation, label_map)
    with ExitStack() as stack:
        scan = _Scan(
            sens=stack.enter_context(SensFile(sens)),
            instances=stack.enter_context(MaskArchive(instances, INSTANCES)),
            labels=stack.enter_context(MaskArchive(labels, LABELS)),
        )
        every = range(0, scan.sens.header.frames, data.stride)
        frames = [f for f in every if is_rigid(scan.sens.poses[f]) and f in scan.instances.frames]
        if not frames:
            raise DataError(f"{sens}: no frame has a finite pose and a mask")
        sightings = _first_pass(scan, frames, labelled, data.min_points)
        chosen = {one: _viewpoints(sightings[one], data.views) for one in labelled}
        crops = _second_pass(scan, chosen, label_map, data.min_points)
    found = []
    for one in labelled:
        used = sorted(crops[one])
        points = np.concatenate([np.empty((0, 3), np.float32), *(crops[one][f] for f in used)])
        reason = ""
        if not chosen[one]:
            reason = f"no frame shows more than {data.min_points} of its points"
        elif not used:
            reason = "the label masks of its chosen frames give it another class"
        origin = f"scene {task.stem}, object {one.object_id}, label {one.label!r}, frames "
        origin += f"{' '.join(map(str, used)) or 'none'}, of {len(sightings[one])}"
        row = ManifestRow("", one.cls, "", origin=origin, views=len(used), reason=reason)
        found.append((replace(row, valid_points=len(points)), points))
    return found


class Registration:
    """The depth camera and masks [h, w] of one resolution, of the shape of colour images."""

    def __init__(self, header: SensHeader, mask_shape: tuple[int, int]) -> None:
        height, width = mask_shape
        scale = (width / header.colour_px[0], height / header.colour_px[1])
        # Half a pixel of slack: a halved image of odd height is rounded.
        assert abs(scale[0] / scale[1] - 1) <= 1 / min(mask_shape), (
            f"masks of {width} x {height} px do not fit colour images of {header.colour_px}"
        )
        k = header.colour_intrinsics
        self._focal = (k[0, 0] * scale[0], k[1, 1] * scale[1])
        self._skew = k[0, 1] * scale[0]
        # Pixel centres are integers, so an image's edge is at -0.5.
        self._centre = tuple((k[i, 2] + 0.5) * scale[i] - 0.5 for i in (0, 1))
        self._mask_shape = mask_shape
        u, v = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in header.depth_px))
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
        self._rays = pixels @ np.linalg.inv(header.depth_intrinsics).T
        move = header.colour_from_depth
        self._turned, self._shift = self._rays @ move[:3, :3].T, move[:3, 3]
        self._parallax = bool(np.linalg.norm(self._shift) > _SAME_PLACE_M)
        self._cell_px = _CELL_DEPTH_PX * max(1.0, self._focal[0] / header.depth_intrinsics[0, 0])

    def mask_pixels(self, depth_m: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
        """Where each depth pixel falls in the mask: [h, w] int64, nearest position, flattened.

        It is -1 outside the mask, where a thing is hidden from the colour camera, and where the
        depth is 0 (nothing was measured), below `NEAR_M` or above `FAR_M`.
        """
        rows, cols = np.nonzero((depth_m >= NEAR_M) & (depth_m <= FAR_M))
        at = self._turned[rows, cols] * depth_m[rows, cols, None].astype(np.float64) + self._shift
        x, y, z = at.T
        ahead = z > 0
        safe = np.where(ahead, z, 1.0)
        u = (self._focal[0] * x + self._skew * y) / safe + self._centre[0]
        v = self._focal[1] * y / safe + self._centre[1]
        height, width = self._mask_shape
        seen = ahead & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        if self._parallax:
            seen[seen] = self._visible(u[seen], v[seen], z[seen])
        found = np.full(depth_m.shape, -1, dtype=np.int64)
        col, row = np.rint(u[seen]).astype(np.int64), np.rint(v[seen]).astype(np.int64)
        found[rows[seen], cols[seen]] = row * width + col
        return found

    def world(
        self,
        depth_m: Float[np.ndarray, "h w"],
        keep: Bool[np.ndarray, "h w"],
        pose: Float[np.ndarray, "4 4"],
    ) -> Float[np.ndarray, "n 3"]:
        """World points, float64, of the pixels `keep`; `pose` is world_from_depth."""
        local = self._rays[keep] * depth_m[keep, None].astype(np.float64)
        return local @ pose[:3, :3].T + pose[:3, 3]

    def _visible(self, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Whether nothing clearly nearer lies in the point's cell or one next to it.

        Those next to it stand for sides, without depth, that only the colour camera sees.
        """
        height, width = self._mask_shape
        col = ((u + 0.5) / self._cell_px).astype(np.int64)
        row = ((v + 0.5) / self._cell_px).astype(np.int64)
        cells = (int(height / self._cell_px) + 1, int(width / self._cell_px) + 1)
        nearest = np.full(cells[0] * cells[1], np.inf)
        cell = row * cells[1] + col
        np.minimum.at(nearest, cell, z)
        around = cv2.erode(nearest.reshape(cells), np.ones((3, 3), np.uint8))
        return z <= (1 + _FARTHER) * around.ravel()[cell]


def agreed(mask: UInt[np.ndarray, "h w"]) -> UInt[np.ndarray, "h w"]:
    """The mask, 0 where a pixel within `_MARGIN_PX` is of something else.

    A ray that misses an object by less than a pixel must not be taken for it: what it hits lies
    far behind, and farthest point sampling would keep every such point.
    """
    square = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
    return np.where(cv2.erode(mask, square) == cv2.dilate(mask, square), mask, 0).astype(mask.dtype)


class Sighting(NamedTuple):
    """A frame that shows enough of an object: its number, where the camera stood, and the points.

    `sum_m` is the sum of the object's points in the world.
    """

    frame: int
    eye_m: Float[np.ndarray, " 3"]
    points: int
    sum_m: Float[np.ndarray, " 3"]


def _viewpoints(seen: Sequence[Sighting], count: int) -> list[int]:
    """Well-spread frames, ascending; see `spread`."""
    if not seen:
        return []
    points = [one.points for one in seen]
    centre = np.sum([one.sum_m for one in seen], axis=0) / sum(points)
    chosen = spread(np.array([one.eye_m for one in seen]) - centre, points, count)
    return sorted(seen[i].frame for i in chosen)


def spread(towards_m: Float[np.ndarray, "n 3"], points: Sequence[int], count: int) -> list[int]:
    """Up to `count` viewpoints, in order: farthest point sampling of their directions.

    The first is the frame with most points; each next one is that whose direction from the
    object is farthest from those of all taken. `towards_m` is from the object's centre to the
    camera of each frame.
    """
    length = np.linalg.norm(towards_m, axis=1, keepdims=True)
    directions = towards_m / np.where(length > 0, length, 1.0)
    first, count = int(np.argmax(points)), min(count, len(directions))
    return farthest_point_sampling_np(directions, count, first).tolist()


@dataclass(frozen=True, eq=False)
class _Scan:
    """The open files of a scene, and where depth pixels fall in masks of each size so far."""

    sens: SensFile
    instances: MaskArchive
    labels: MaskArchive
    known: dict[tuple[int, int], Registration] = field(default_factory=dict)

    def see(
        self, frame: int, mask: np.ndarray
    ) -> tuple[Registration, np.ndarray, np.ndarray, np.ndarray]:
        """The cameras; [h, w] depth, mask of each depth pixel (or 0), and its position there."""
        shape = (mask.shape[0], mask.shape[1])
        if shape not in self.known:
            with reading(f"{self.instances.path}, frame {frame}"):
                self.known[shape] = Registration(self.sens.header, shape)
        registration, depth_m = self.known[shape], self.sens.depth_m(frame)
        where = registration.mask_pixels(depth_m)
        return registration, depth_m, np.where(where >= 0, agreed(mask).ravel()[where], 0), where


def _first_pass(
    scan: _Scan, frames: Sequence[int], labelled: Sequence[Labelled], min_points: int
) -> dict[Labelled, list[Sighting]]:
    """How much of which object each frame shows."""
    sightings: dict[Labelled, list[Sighting]] = {one: [] for one in labelled}
    for frame in frames:
        mask = scan.instances.read(frame)
        there = np.flatnonzero(np.bincount(mask.ravel()))
        shown = [one for one in labelled if one.object_id + 1 in there]
        if not shown:
            continue
        registration, depth_m, ids, _ = scan.see(frame, mask)
        pose = scan.sens.poses[frame]
        for one in shown:
            points = registration.world(depth_m, ids == one.object_id + 1, pose)
            if len(points) > min_points:
                seen = Sighting(frame, pose[:3, 3], len(points), points.sum(axis=0))
                sightings[one].append(seen)
    return sightings


def _second_pass(
    scan: _Scan,
    chosen: Mapping[Labelled, Sequence[int]],
    label_map: LabelMap,
    min_points: int,
) -> dict[Labelled, dict[int, np.ndarray]]:
    """The pixels of chosen frames to which the label mask gives the object's class.

    A frame counts if these are more than `min_points` and more than half of its pixels.
    """
    crops: dict[Labelled, dict[int, np.ndarray]] = {one: {} for one in chosen}
    of_frame: dict[int, list[Labelled]] = defaultdict(list)
    for one, frames in chosen.items():
        for frame in frames:
            of_frame[frame].append(one)
    for frame in sorted(of_frame):
        mask, labels = scan.instances.read(frame), scan.labels.read(frame)
        registration, depth_m, ids, where = scan.see(frame, mask)
        if labels.shape != mask.shape:
            raise DataError(f"{scan.labels.path}, frame {frame}: another size than the instances'")
        for one in of_frame[frame]:
            keep = ids == one.object_id + 1
            fitting = [n for n, cls in label_map.class_of_id.items() if cls == one.cls]
            agrees = keep & np.isin(labels.ravel()[where], fitting)
            if 2 * agrees.sum() > keep.sum() and agrees.sum() > min_points:
                points = registration.world(depth_m, agrees, scan.sens.poses[frame])
                crops[one][frame] = points.astype(np.float32)
    return crops
