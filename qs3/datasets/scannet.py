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
    Labelled,
    LabelMap,
    SceneFiles,
    find_scenes,
    read_label_map,
    read_scene_list,
)
from qs3.datasets.scannet_scene import Extraction, ObjectCloud, SceneResult, extract_scene
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
_PLAIN = ("frames", "frames_used", "frames_lost", "frames_unmasked", "notes")


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
            SceneResult(files, reason=failed[files.scene])
            if files.scene in failed
            else _load(parts, files)
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
            return _part(extract_scene(files, label_map, settings))
        except Qs3Error as error:
            return str(error)
        except Exception as error:  # one odd scene must not stop a thousand
            log.exception("%s: unexpected error", files.scene)
            return f"unexpected {type(error).__name__}: {error}"

    return work


def _part(result: SceneResult) -> Part:
    objects = result.objects
    note = {
        "split": result.files.split,
        "sizes": result.files.sizes(),
        "plain": {key: getattr(result, key) for key in _PLAIN},
        "objects": [dataclasses.asdict(dataclasses.replace(o, cloud=None)) for o in objects],
    }
    clouds = {str(o.labelled.object_id): o.cloud for o in objects if o.cloud is not None}
    return note, clouds


def _done(parts: PartFiles, files: SceneFiles) -> bool:
    """Whether there is a part of the scene, made from files of these sizes for this split."""
    if not parts.has(files.scene):
        return False
    note, _ = parts.open(files.scene)
    return note["split"] == files.split and note["sizes"] == files.sizes()


def _load(parts: PartFiles, files: SceneFiles) -> SceneResult:
    note, clouds = parts.read(files.scene)
    objects = []
    for one in note["objects"]:
        labelled = Labelled(**one.pop("labelled"))
        one |= {"frames": tuple(one["frames"]), "cloud": clouds.get(str(labelled.object_id))}
        objects.append(ObjectCloud(labelled, **one))
    return SceneResult(files, tuple(objects), **note["plain"])


def _write(
    out: Path, scans: Path, results: Sequence[SceneResult], recipe: dict[str, Any]
) -> PointSet:
    """The dataset, unless it is there already with exactly these scenes."""
    table = _scenes_csv(results, scans)
    digest = hashlib.sha256(table.encode()).hexdigest()
    if is_finished(out) and read_meta(out).get("scenes_sha256") == digest:
        log.info("nothing has changed since %s was written", out)
        return open_pointset(out)
    objects = [(result.files, one) for result in results for one in result.objects]
    # Class by class, train before test, as the other datasets.
    objects.sort(key=lambda pair: (CLASSES.index(pair[1].labelled.cls), pair[0].split == "test"))
    clouds = [one.cloud for _, one in objects if one.cloud is not None]
    if not clouds:
        why = next((f"{r.files.scene}: {r.reason}" for r in results if r.reason), "")
        raise DataError(f"no object of {len(results)} scenes gave a cloud; {why}")
    write_text(out / SCENES, table)
    return write_pointset(
        out,
        name=out.name,
        classes=CLASSES,
        arrays={"points": clouds},
        rows=[_row(files, one) for files, one in objects],
        meta={
            "simulated": False,
            **MadeOf(objects="ScanNet's raw depth, cropped by its masks here").meta,
            "scenes": len(results),
            "scenes_failed": sum(bool(result.reason) for result in results),
            "scenes_sha256": digest,
            **{"extraction" if key == "settings" else key: value for key, value in recipe.items()},
        },
    )


def _row(files: SceneFiles, one: ObjectCloud) -> ManifestRow:
    """The manifest's row; `origin` says scene, object, label and frames."""
    labelled = one.labelled
    frames = " ".join(map(str, one.frames)) or "none"
    return ManifestRow(
        id=f"{labelled.cls}/{files.split}/{files.scene}_{labelled.object_id}",
        cls=labelled.cls,
        split=files.split,
        origin=f"scene {files.scene}, object {labelled.object_id}, label {labelled.label!r}, "
        f"frames {frames}, of {one.candidates}",
        views=len(one.frames),
        valid_points=one.fused_points,
        status="ok" if one.cloud is not None else "skipped",
        reason=one.reason,
    )


def _scenes_csv(results: Sequence[SceneResult], scans: Path) -> str:
    """One line a scene; paths in it are relative to `scans`, so it is the same anywhere."""
    counts = ("frames", "frames_used", "frames_lost", "frames_unmasked")
    rows: list[Sequence[Any]] = [
        ("scene", "split", "status", "objects", "clouds", *counts, "sha256", "notes")
    ]
    for result in results:
        digest = hashlib.sha256()
        for one in result.objects:
            digest.update(repr((one.labelled, one.frames, one.reason)).encode())
            digest.update(b"" if one.cloud is None else one.cloud.tobytes())
        notes = "; ".join(filter(None, [result.reason, *result.notes]))
        status = "failed" if result.reason else "ok"
        clouds = sum(one.cloud is not None for one in result.objects)
        row = [result.files.scene, result.files.split, status, len(result.objects), clouds]
        row += [getattr(result, key) for key in counts]
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


def _report(pointset: PointSet, results: Sequence[SceneResult], out: Path) -> None:
    """Counts a class, what was left out, and the content hash."""
    missed = (o.labelled.cls for result in results for o in result.objects if o.cloud is None)
    for line in counts_text(pointset, "skipped", Counter(missed)):
        log.info("%s", line)
    log.info("frames left out for their pose: %d", sum(r.frames_lost for r in results))
    if failed := sum(bool(result.reason) for result in results):
        log.warning("%d of %d scenes failed; %s says why", failed, len(results), SCENES)
    log.info("in %s, content hash %s", out, pointset.sha256[:16])
