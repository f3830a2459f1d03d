"""One scene of ScanNet: its files in, the clouds of its objects out.

Two passes over the recording, each with one frame in memory. The first finds which frames show
enough of which object, and from where; the second crops the chosen ones.

Masks have the colour camera's view. A depth pixel is back-projected with the depth intrinsics,
moved to the colour camera with the extrinsics, and projected with the colour intrinsics, scaled to
the mask's resolution. What the colour camera cannot see, because something nearer hides it from
there and not from the depth camera, gets no mask pixel: it would get the label of what hides it.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Bool, Float, Int, UInt

from qs3.datasets.frames import Part
from qs3.datasets.scannet_files import (
    INSTANCES,
    LABELS,
    Labelled,
    LabelMap,
    MaskArchive,
    SceneFiles,
    SensFile,
    SensHeader,
    read_objects,
)
from qs3.errors import DataError
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.utils.settings import settings

_FARTHER = 0.05  # of the depth: surfaces that differ by more are a nearer and a farther one
# A cell of the nearest-surface map, in depth pixels: each cell of a visible surface gets a sample.
_CELL_DEPTH_PX = 2.0
_SAME_PLACE_M = 1e-6


@settings
class Extraction:
    """Settings of the extraction; the paper names points, min_points and views.

    Attributes:
        points: of a cloud (farthest point sampling).
        min_points: a frame counts if it shows more points of the object than this.
        views: frames fused, far from each other in direction; fewer if there are fewer.
        stride: look at every n-th frame only; 10 takes a tenth of the time.
        depth_min_m, depth_max_m: nearer and farther depths are left out.
        margin_px: pixels about a mask's pixel that must show the same object, too (`agreed`).
        column: of the label map; raw_category has the annotators' very words.
    """

    points: Annotated[int, Ge(1)] = 2048
    min_points: Annotated[int, Ge(0)] = 1000
    views: Annotated[int, Ge(1)] = 10
    stride: Annotated[int, Ge(1)] = 1
    depth_min_m: Annotated[float, Gt(0)] = 0.1
    depth_max_m: Annotated[float, Gt(0)] = 10.0
    margin_px: Annotated[int, Ge(0)] = 1
    column: Literal["category", "raw_category"] = "category"


def extract_scene(files: SceneFiles, label_map: LabelMap, settings: Extraction) -> Part:
    """The clouds of a scene's objects.

    Returns:
        A note with numbers of frames: in the recording, looked at, left out for their pose and for
        their mask; `notes` of what is odd; and `objects` by object id, each with its label and
        class, the frames that were fused, how many showed enough of it, its points before sampling,
        and `reason`, why there is no cloud. And the clouds [points, 3] float32 by object id, in the
        scene's world, metres, z up.
    """
    sens, instances = files.need("sens"), files.need("instances")
    labelled, notes = read_objects(files.need("aggregation"), label_map)
    with ExitStack() as stack:
        scan = _Scan(
            sens=stack.enter_context(SensFile(sens)),
            instances=stack.enter_context(MaskArchive(instances, INSTANCES)),
            labels=stack.enter_context(MaskArchive(files.labels, LABELS)) if files.labels else None,
            settings=settings,
        )
        every = range(0, len(scan.sens), settings.stride)
        posed = [frame for frame in every if scan.sens.has_pose(frame)]
        frames = [frame for frame in posed if frame in scan.instances.frames]
        if not frames:
            raise DataError(f"{sens}: no frame has a finite pose and a mask")
        if files.labels is None:
            notes = [*notes, "no label masks to check the classes"]
        sightings = _first_pass(scan, frames, labelled)
        chosen = {one: sightings[one].viewpoints(settings.views) for one in labelled}
        crops, denied = _second_pass(scan, chosen, label_map)
    objects, clouds = [], {}
    for one in labelled:
        made, cloud = _finish(one, sightings[one], crops[one], denied[one], settings)
        objects.append(made)
        if cloud is not None:
            clouds[str(one.object_id)] = cloud
    note = {
        "split": files.split,
        "sizes": files.sizes(),
        "frames": len(scan.sens),
        "frames_used": len(frames),
        "frames_lost": len(every) - len(posed),
        "frames_unmasked": len(posed) - len(frames),
        "notes": notes,
        "objects": objects,
    }
    return note, clouds


class Registration:
    """The depth camera and the masks of one resolution."""

    def __init__(self, header: SensHeader, mask_shape: tuple[int, int], where: str) -> None:
        """Prepare the rays for masks [h, w]; DataError if colour images have another shape."""
        height, width = mask_shape
        scale = (width / header.colour_px[0], height / header.colour_px[1])
        # Half a pixel of slack: a halved image of odd height is rounded.
        if abs(scale[0] / scale[1] - 1) > 1 / min(mask_shape):
            raise DataError(
                f"{where}: masks of {width} x {height} px do not fit colour images of "
                f"{header.colour_px}"
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

    def mask_pixels(
        self, depth_m: Float[np.ndarray, "h w"], near_m: float, far_m: float
    ) -> Int[np.ndarray, "h w"]:
        """Where each depth pixel falls in the mask: [h, w] int64, nearest position, flattened.

        It is -1 outside the mask, where a thing is hidden from the colour camera, and where the
        depth is 0 (nothing was measured), below `near_m` or above `far_m`.
        """
        rows, cols = np.nonzero((depth_m >= near_m) & (depth_m <= far_m))
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
        """[n, 3] float64 world points of the pixels `keep`; `pose` is world_from_depth."""
        local = self._rays[keep] * depth_m[keep, None].astype(np.float64)
        return local @ pose[:3, :3].T + pose[:3, 3]

    def _visible(self, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> Bool[np.ndarray, " n"]:
        """[n] bool: nothing clearly nearer lies in the point's cell or one next to it.

        The cells next to it stand for sides of a nearer thing that only the colour camera sees:
        no depth was measured there. It costs what lies behind an edge a few pixels.
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


def agreed(mask: UInt[np.ndarray, "h w"], margin_px: int) -> UInt[np.ndarray, "h w"]:
    """The mask, 0 where a pixel within `margin_px` is of something else.

    With a margin of 1 px a ray that misses an object by less than a pixel is not taken for it:
    what it hits lies far behind, and farthest point sampling would keep every such point. A margin
    of 0 leaves the mask as it is.
    """
    if margin_px == 0:
        return mask
    square = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return np.where(cv2.erode(mask, square) == cv2.dilate(mask, square), mask, 0).astype(mask.dtype)


@dataclass(eq=False)
class Sightings:
    """What the first pass notes of one object: the frames that show enough of it.

    Attributes:
        frames, eyes_m, counts, sums_m: of each such frame its number, the camera's position [3],
            the number of the object's points, and their sum [3] in the world.
        most: most points in any frame, enough or not, and that frame; (0, -1) if never seen.
    """

    frames: list[int] = field(default_factory=list)
    eyes_m: list[np.ndarray] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    sums_m: list[np.ndarray] = field(default_factory=list)
    most: tuple[int, int] = (0, -1)

    def see(self, frame: int, points_m: np.ndarray, eye_m: np.ndarray, more_than: int) -> None:
        """Note a frame: [n, 3] points of the object in the world, [3] the camera's position."""
        count = len(points_m)
        if count > self.most[0]:
            self.most = (count, frame)
        if count > more_than:
            self.frames.append(frame)
            self.eyes_m.append(eye_m)
            self.counts.append(count)
            self.sums_m.append(points_m.sum(axis=0))

    def viewpoints(self, count: int) -> tuple[int, ...]:
        """Well-spread frames, ascending; see `spread`."""
        if not self.frames:
            return ()
        centre = np.sum(self.sums_m, axis=0) / sum(self.counts)
        chosen = spread(np.array(self.eyes_m) - centre, self.counts, count)
        return tuple(sorted(self.frames[i] for i in chosen))


def spread(towards_m: Float[np.ndarray, "n 3"], points: Sequence[int], count: int) -> list[int]:
    """Up to `count` viewpoints, in order: farthest point sampling of their directions.

    The first is the frame with most points; each next one is that whose direction from the
    object is farthest from those of all taken. Of equals the earliest is taken.

    Args:
        towards_m: from the object's centre to the camera of each frame.
        points: of the object in each frame.
        count: of viewpoints.
    """
    length = np.linalg.norm(towards_m, axis=1, keepdims=True)
    directions = towards_m / np.where(length > 0, length, 1.0)
    chosen = [int(np.argmax(points))]
    gap = np.full(len(directions), np.inf)
    while len(chosen) < min(count, len(directions)):
        gap = np.minimum(gap, np.linalg.norm(directions - directions[chosen[-1]], axis=1))
        gap[chosen] = -1.0  # also where all stand at one place
        chosen.append(int(np.argmax(gap)))
    return chosen


@dataclass(frozen=True, eq=False)
class _Scan:
    """The open files of a scene, and where depth pixels fall in masks of each size so far."""

    sens: SensFile
    instances: MaskArchive
    labels: MaskArchive | None
    settings: Extraction
    known: dict[tuple[int, int], Registration] = field(default_factory=dict)

    def registration(self, mask: np.ndarray, frame: int) -> Registration:
        """That of the mask's resolution, made once."""
        shape = (mask.shape[0], mask.shape[1])
        if shape not in self.known:
            where = f"{self.instances.path}, frame {frame}"
            self.known[shape] = Registration(self.sens.header, shape, where)
        return self.known[shape]

    def object_ids(
        self, registration: Registration, mask: np.ndarray, depth_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """[h, w] pixel of the instance mask of each depth pixel, or 0; and its position there."""
        s = self.settings
        where = registration.mask_pixels(depth_m, s.depth_min_m, s.depth_max_m)
        found = agreed(mask, s.margin_px).ravel()[where]
        return np.where(where >= 0, found, 0), where


def _first_pass(
    scan: _Scan, frames: Sequence[int], labelled: Sequence[Labelled]
) -> dict[Labelled, Sightings]:
    """How much of which object each frame shows."""
    sightings = {one: Sightings() for one in labelled}
    for frame in frames:
        mask = scan.instances.read(frame)
        there = np.flatnonzero(np.bincount(mask.ravel()))
        shown = [one for one in labelled if one.object_id + 1 in there]
        if not shown:
            continue
        registration = scan.registration(mask, frame)
        depth_m, pose = scan.sens.depth_m(frame), scan.sens.poses[frame]
        ids, _ = scan.object_ids(registration, mask, depth_m)
        for one in shown:
            points = registration.world(depth_m, ids == one.object_id + 1, pose)
            sightings[one].see(frame, points, pose[:3, 3], scan.settings.min_points)
    return sightings


def _second_pass(
    scan: _Scan, chosen: Mapping[Labelled, Sequence[int]], label_map: LabelMap
) -> tuple[dict[Labelled, dict[int, np.ndarray]], dict[Labelled, int]]:
    """The crops of the chosen frames, and in how many of them the label masks deny the class.

    A pixel counts if the label mask gives it the object's class; a frame counts if more than
    `min_points` of its pixels and more than half of them do.
    """
    crops: dict[Labelled, dict[int, np.ndarray]] = {one: {} for one in chosen}
    denied: dict[Labelled, int] = dict.fromkeys(chosen, 0)
    of_frame: dict[int, list[Labelled]] = defaultdict(list)
    for one, frames in chosen.items():
        for frame in frames:
            of_frame[frame].append(one)
    for frame in sorted(of_frame):
        mask = scan.instances.read(frame)
        registration = scan.registration(mask, frame)
        depth_m, pose = scan.sens.depth_m(frame), scan.sens.poses[frame]
        ids, where = scan.object_ids(registration, mask, depth_m)
        labels = None if scan.labels is None else scan.labels.read(frame)
        if labels is not None and labels.shape != mask.shape:
            raise DataError(f"{scan.sens.path}, frame {frame}: masks of different sizes")
        for one in of_frame[frame]:
            keep = ids == one.object_id + 1
            if labels is not None:
                fitting = [n for n, cls in label_map.class_of_id.items() if cls == one.cls]
                agrees = keep & np.isin(labels.ravel()[where], fitting)
                half = 2 * agrees.sum() > keep.sum()
                if not half or agrees.sum() <= scan.settings.min_points:
                    denied[one] += 1
                    continue
                keep = agrees
            crops[one][frame] = registration.world(depth_m, keep, pose).astype(np.float32)
    return crops, denied


def _finish(
    one: Labelled,
    sightings: Sightings,
    crops: Mapping[int, np.ndarray],
    denied: int,
    settings: Extraction,
) -> tuple[dict[str, Any], np.ndarray | None]:
    """The object's note and its cloud from its crops; None with a reason if there is none."""
    fused = np.concatenate([np.empty((0, 3), np.float32), *(crops[f] for f in sorted(crops))])
    note = {
        **dataclasses.asdict(one),
        "frames": sorted(crops),
        "candidates": len(sightings.frames),
        "fused_points": len(fused),
        "reason": "",
    }
    if not sightings.frames:
        most, frame = sightings.most
        why = f"no frame shows more than {settings.min_points} of its points; the most are "
        return {**note, "reason": f"{why}{most}, in frame {frame}"}, None
    if not crops:
        why = f"the label masks of its chosen frames ({denied}) give it another class"
        return {**note, "reason": why}, None
    points = fused.astype(np.float64)
    # Of fewer points than that the order starts over, as `farthest_point_sampling_np` says.
    chosen = farthest_point_sampling_np(points, settings.points)
    return note, points[chosen].astype(np.float32)
