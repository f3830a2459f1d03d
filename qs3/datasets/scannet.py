"""DepthScanNet10 from raw ScanNet: the objects of ten classes as the depth camera measured them.

The paper (section 4, "Benchmarking Data") describes the dataset and no code for it was released.
What is fixed there: instance masks crop the depth images, only crops of more than 1,000 points
are kept, those of 10 viewpoints are fused, and 2,048 points are kept; scenes and split are those
of PointDA-10's ScanNet10. What is not, is decided here and in `qs3.datasets.scannet_scene`.

The dataset depends on the scenes, the label map, the lists and the settings alone: neither the
number of workers, nor their order, nor an interruption changes a byte of it. The parts, a scene
each, stay next to the finished dataset: scenes that come later are added to them. They hold as much
as the dataset, and may be deleted when it is complete.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qs3.classes import CLASSES
from qs3.datasets.frames import Part, finish_parts
from qs3.datasets.scannet_files import (
    LabelMap,
    SceneFiles,
    find_scenes,
    read_label_map,
    read_scene_list,
)
from qs3.datasets.scannet_scene import Extraction, extract_scene
from qs3.errors import DataError, Qs3Error
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf, is_finished, read_meta
from qs3.store.parts import RECIPE, PartFiles, check_ours, delete_dataset
from qs3.store.store import PointSet, counts_text, open_pointset, write_pointset
from qs3.utils.files import make_folder, sha256_file, write_text
from qs3.utils.locks import locked
from qs3.utils.pool import Pool, Processes
from qs3.utils.text_table import csv_text
from qs3.utils.version import VERSION

log = logging.getLogger(__name__)

SCENES = "scenes.csv"
_COUNTS = ("frames", "frames_used", "frames_lost", "frames_unmasked")
_FAILED: dict[str, Any] = {**dict.fromkeys(_COUNTS, 0), "objects": []}

Result = tuple[SceneFiles, dict[str, Any], dict[str, np.ndarray]]
"""A scene's files, its note and its clouds, or a note with the reason why it failed."""


def extract(
    *,
    scans: Path,
    labels: Path,
    train: Path,
    val: Path,
    out: Path,
    settings: Extraction | None = None,
    force: bool = False,
    pool: Pool | None = None,
) -> PointSet:
    """Make the dataset at `out`, continue it, add scenes that came since, or find it finished.

    A second call with the same `out` waits for the first, and then finds its work. Scenes that fail
    are in scenes.csv with the reason, and are tried again by the next call.

    Args:
        scans: ScanNet's folder of scenes, which all of the pool's machines see.
        labels: scannetv2-labels.combined.tsv.
        train, val: scannetv2_train.txt and scannetv2_val.txt; the latter is our split "test".
        out: folder of the dataset.
        settings: None is the defaults.
        force: delete first what an earlier call left at `out`.
        pool: of processes; None: this one.

    Raises:
        ConfigError: `out` was made with other settings.
        MissingDataError: a file or the folder of scenes is not there.
        DataError: no object gave a cloud, or `out` holds a dataset of other origin.
    """
    settings = settings or Extraction()
    scans, out = scans.absolute(), out.absolute()
    label_map = read_label_map(labels, settings.column)
    scenes = find_scenes(scans, read_scene_list(train), read_scene_list(val))
    recipe = {
        "settings": dataclasses.asdict(settings),
        "labels": {"sha256": sha256_file(labels)},
        "versions": _versions(),
    }
    make_folder(out)
    with locked(out / ".lock"):
        check_ours(out, "qs3 scannet")
        if force and (is_finished(out) or (out / RECIPE).is_file()):
            (out / SCENES).unlink(missing_ok=True)
            delete_dataset(out)
        parts = PartFiles(out)
        if is_finished(out) and not parts.are_there:
            parts.check(recipe)
            log.info("%s is finished, and its parts were deleted: nothing to do", out)
            return open_pointset(out)
        parts.begin(recipe)
        todo = [(files.scene, files) for files in scenes if not _done(parts, files)]
        make = partial(_worker, label_map, settings, recipe["versions"])
        failed = finish_parts(parts, todo, make, pool or Processes(0), "scenes", stop=False)
        results = [
            (files, {**_FAILED, "reason": failed[files.scene]}, {})
            if files.scene in failed
            else (files, *parts.read(files.scene))
            for files in scenes
        ]
        pointset = _write(out, scans, results, recipe)
        _report(pointset, results, out)
    return pointset


def _worker(
    label_map: LabelMap, settings: Extraction, versions: dict[str, str]
) -> Callable[[SceneFiles], Part | str]:
    """What a process does with each scene."""
    if (here := _versions()) != versions:
        raise DataError(f"a worker's machine has {here}, this one {versions}")

    def work(files: SceneFiles) -> Part | str:
        try:
            return extract_scene(files, label_map, settings)
        except Qs3Error as error:
            return str(error)
        except Exception as error:  # one odd scene must not stop a thousand
            log.exception("%s: unexpected error", files.scene)
            return f"unexpected {type(error).__name__}: {error}"

    return work


def _done(parts: PartFiles, files: SceneFiles) -> bool:
    """Whether there is a part of the scene, made from files of these sizes for this split."""
    if not parts.has(files.scene):
        return False
    note, _ = parts.open(files.scene)
    return note["split"] == files.split and note["sizes"] == files.sizes()


def _write(out: Path, scans: Path, results: Sequence[Result], recipe: dict[str, Any]) -> PointSet:
    """The dataset, unless it is there already with exactly these scenes."""
    table = _scenes_csv(results, scans)
    digest = hashlib.sha256(table.encode()).hexdigest()
    if is_finished(out) and read_meta(out).get("scenes_sha256") == digest:
        log.info("nothing has changed since %s was written", out)
        return open_pointset(out)
    found = [
        (files, one, clouds.get(str(one["object_id"])))
        for files, note, clouds in results
        for one in note["objects"]
    ]
    # Class by class, train before test, as the other datasets.
    found.sort(key=lambda f: (CLASSES.index(f[1]["cls"]), f[0].split == "test"))
    clouds = [cloud for _, _, cloud in found if cloud is not None]
    if not clouds:
        why = [f"{files.scene}: {note['reason']}" for files, note, _ in results if "reason" in note]
        raise DataError("\n  ".join([f"no object of {len(results)} scenes gave a cloud", *why[:5]]))
    write_text(out / SCENES, table)
    return write_pointset(
        out,
        name=out.name,
        classes=CLASSES,
        arrays={"points": clouds},
        rows=[_row(files, one) for files, one, _ in found],
        meta={
            "simulated": False,
            **MadeOf(objects="ScanNet's raw depth, cropped by its masks here").meta,
            "scenes": len(results),
            "scenes_failed": sum("reason" in note for _, note, _ in results),
            "scenes_sha256": digest,
            **{"extraction" if key == "settings" else key: value for key, value in recipe.items()},
        },
    )


def _row(files: SceneFiles, one: dict[str, Any]) -> ManifestRow:
    """The manifest's row; `origin` says scene, object, label and frames."""
    number, frames = one["object_id"], " ".join(map(str, one["frames"])) or "none"
    return ManifestRow(
        id=f"{one['cls']}/{files.split}/{files.scene}_{number}",
        cls=one["cls"],
        split=files.split,
        origin=f"scene {files.scene}, object {number}, label {one['label']!r}, "
        f"frames {frames}, of {one['candidates']}",
        views=len(one["frames"]),
        valid_points=one["fused_points"],
        status="skipped" if one["reason"] else "ok",
        reason=one["reason"],
    )


def _scenes_csv(results: Sequence[Result], scans: Path) -> str:
    """One line a scene; paths in it are relative to `scans`, so it is the same anywhere."""
    rows: list[Sequence[Any]] = [
        ("scene", "split", "status", "objects", "clouds", *_COUNTS, "sha256", "notes")
    ]
    for files, note, clouds in results:
        digest = hashlib.sha256(repr(note["objects"]).encode())
        for key in sorted(clouds):
            digest.update(clouds[key].tobytes())
        status = "failed" if "reason" in note else "ok"
        notes = "; ".join([note["reason"]] if "reason" in note else note["notes"])
        row = [files.scene, files.split, status, len(note["objects"]), len(clouds)]
        row += [note[key] for key in _COUNTS]
        rows.append([*row, digest.hexdigest()[:16], notes.replace(f"{scans}/", "")])
    return csv_text(rows)


def _versions() -> dict[str, str]:
    """What may change a number in a cloud."""
    return {
        "qs3": VERSION,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "fpsample": version("fpsample"),
    }


def _report(pointset: PointSet, results: Sequence[Result], out: Path) -> None:
    """Counts a class, what was left out, and the content hash."""
    missed = (one["cls"] for _, note, _ in results for one in note["objects"] if one["reason"])
    for line in counts_text(pointset, "skipped", Counter(missed)):
        log.info("%s", line)
    lost = sum(note["frames_lost"] for _, note, _ in results)
    log.info("frames left out for their pose: %d", lost)
    if failed := sum("reason" in note for _, note, _ in results):
        log.warning("%d of %d scenes failed; %s says why", failed, len(results), SCENES)
    log.info("in %s, content hash %s", out, pointset.sha256[:16])
