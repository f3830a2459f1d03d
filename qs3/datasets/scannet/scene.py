"""One scene: its files in, the clouds of its objects out.

Two passes over the recording, each with one frame in memory. The first finds which frames show
enough of which object, and from where; the second crops the chosen ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np

from qs3.datasets.scannet.files import SceneFiles
from qs3.datasets.scannet.labels import Labelled, LabelMap, read_objects
from qs3.datasets.scannet.masks import INSTANCES, LABELS, MaskArchive
from qs3.datasets.scannet.objects import ObjectCloud, Sightings, sampled
from qs3.datasets.scannet.registration import Registration, agreed
from qs3.datasets.scannet.sens import SensFile
from qs3.datasets.scannet.settings import Extraction
from qs3.errors import DataError


@dataclass(frozen=True, eq=False)
class SceneResult:
    """What became of one scene.

    Attributes:
        files: which scene.
        objects: those of the ten classes, by object id; empty if the scene failed.
        frames: in the recording.
        frames_used: looked at: with a pose and a mask.
        frames_lost: left out because their pose is not finite or no rigid motion.
        frames_unmasked: left out because there is no mask.
        notes: what is odd about it.
        reason: why the scene failed; empty if it did not.
    """

    files: SceneFiles
    objects: tuple[ObjectCloud, ...] = ()
    frames: int = 0
    frames_used: int = 0
    frames_lost: int = 0
    frames_unmasked: int = 0
    notes: Sequence[str] = ()
    reason: str = ""


def extract_scene(files: SceneFiles, label_map: LabelMap, settings: Extraction) -> SceneResult:
    """The clouds of a scene's objects.

    Raises:
        DataError: a file is missing or damaged.
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
        frames, lost, unmasked = _usable_frames(scan)
        if not frames:
            raise DataError(
                f"{sens}: none of its {len(scan.sens)} frames has a finite pose and a mask"
            )
        if files.labels is None:
            notes = [*notes, "no label masks to check the classes"]
        sightings = _first_pass(scan, frames, labelled)
        chosen = {one: sightings[one].viewpoints(settings.views) for one in labelled}
        crops, denied = _second_pass(scan, chosen, label_map)
    objects = tuple(
        _finish(one, sightings[one], crops[one], denied[one], settings) for one in labelled
    )
    return SceneResult(files, objects, len(scan.sens), len(frames), lost, unmasked, notes)


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


def _usable_frames(scan: _Scan) -> tuple[list[int], int, int]:
    """Frames with a pose and a mask; how many have no pose; and how many others no mask."""
    every = range(0, len(scan.sens), scan.settings.stride)
    posed = [frame for frame in every if scan.sens.has_pose(frame)]
    usable = [frame for frame in posed if frame in scan.instances.frames]
    return usable, len(every) - len(posed), len(posed) - len(usable)


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
        labels = _labels(scan, frame, mask.shape)
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


def _labels(scan: _Scan, frame: int, shape: tuple[int, ...]) -> np.ndarray | None:
    """The label mask of a frame, or None if there are no label masks."""
    if scan.labels is None:
        return None
    labels = scan.labels.read(frame)
    if labels.shape != shape:
        raise DataError(
            f"{scan.labels.path}, frame {frame}: {labels.shape[1]} x {labels.shape[0]} px, but the "
            f"instance mask has {shape[1]} x {shape[0]}"
        )
    return labels


def _finish(
    one: Labelled,
    sightings: Sightings,
    crops: Mapping[int, np.ndarray],
    denied: int,
    settings: Extraction,
) -> ObjectCloud:
    """The object's cloud from its crops, or why there is none."""
    nothing = ObjectCloud(one, (), len(sightings.frames), 0, None)
    if not sightings.frames:
        most, frame = sightings.most
        if most == 0:
            return replace(nothing, reason="no frame with a pose and a mask shows it")
        return replace(
            nothing,
            reason=f"no frame shows more than {settings.min_points} of its points; the most are "
            f"{most}, in frame {frame}",
        )
    if not crops:
        return replace(
            nothing,
            reason=f"the label masks of all {denied} chosen frames give it another class"
            if denied > 1
            else "the label mask of the only chosen frame gives it another class",
        )
    fused = np.concatenate([crops[frame] for frame in sorted(crops)]).astype(np.float64)
    return replace(
        nothing,
        frames=tuple(sorted(crops)),
        fused_points=len(fused),
        cloud=sampled(fused, settings.points),
    )
