"""All scenes of ScanNet to the dataset: find, extract in parallel, resume, write.

The dataset depends on the scenes, the label map, the lists and the settings alone: neither the
number of workers, nor their order, nor an interruption changes a byte of it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import platform
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qs3.classes import CLASSES
from qs3.config.checks import check_int
from qs3.datasets.scannet.files import SceneFiles, find_scenes
from qs3.datasets.scannet.labels import LabelMap, read_label_map, read_scene_list
from qs3.datasets.scannet.objects import ObjectCloud
from qs3.datasets.scannet.scene import SceneResult, extract_scene
from qs3.datasets.scannet.scene_parts import SceneParts
from qs3.datasets.scannet.settings import Extraction
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.store.parts import RECIPE, check_ours, delete_dataset
from qs3.store.store import (
    PointSet,
    counts_text,
    is_finished,
    open_pointset,
    read_meta,
    write_pointset,
)
from qs3.utils.files import make_folder, sha256_file, write_text
from qs3.utils.locks import locked
from qs3.utils.plural import counted
from qs3.utils.pool import Pool, Processes
from qs3.utils.progress import progress_bar
from qs3.utils.text_table import csv_text
from qs3.utils.version import VERSION

log = logging.getLogger(__name__)

SCENES = "scenes.csv"
_FAILURES_SHOWN = 5
_DIED = "the worker process died on this scene each time (out of memory, or a crash)"
_COLUMNS = (
    "scene", "split", "status", "objects", "clouds",
    "frames", "frames_used", "frames_lost", "frames_unmasked", "sha256", "notes",
)  # fmt: skip


def extract(
    *,
    scans: Path,
    labels: Path,
    train: Path,
    val: Path,
    out: Path,
    settings: Extraction | None = None,
    workers: int = 1,
    force: bool = False,
    pool: Pool | None = None,
) -> PointSet:
    """Make the dataset at `out`, continue it, add scenes that came since, or find it finished.

    A second call with the same `out` waits for the first, and then finds its work.

    Scenes that fail are in scenes.csv with the reason, and are tried again by the next call.

    Args:
        scans: ScanNet's folder of scenes.
        labels: scannetv2-labels.combined.tsv.
        train, val: scannetv2_train.txt and scannetv2_val.txt; the latter is our split "test".
        out: folder of the dataset.
        settings: None is the defaults.
        workers: processes; 0 works in this one.
        force: delete first what an earlier call left at `out`.
        pool: who does it, with all files on a disk that its machines see; None: `workers`.

    Raises:
        ConfigError: `out` was made with other settings.
        MissingDataError: a file or the folder of scenes is not there.
        DataError: no object gave a cloud, or `out` holds a dataset of other origin.
    """
    settings = settings or Extraction()
    pool = pool or Processes(check_int("workers", workers, 0))
    if not pool.shared_disk:
        raise ConfigError("scenes are not sent: engine.shared_disk=true, on a disk that all see")
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
        parts = SceneParts(out)
        parts.check(recipe)
        if is_finished(out) and not parts.are_there:
            log.info("%s is finished, and its parts were deleted: nothing to do", out)
            return open_pointset(out)
        parts.begin(recipe)
        make = partial(_worker, label_map, settings, parts, alone=pool.at_once == 0)
        if pool.elsewhere:
            make = partial(_checked, make, parts, parts.recipe_sha256(), recipe["versions"])
        results = _results(make, parts, scenes, pool)
        pointset = _write(out, scans, results, recipe)
        _report(pointset, results, out)
    return pointset


def _worker(
    label_map: LabelMap, settings: Extraction, parts: SceneParts, alone: bool
) -> Callable[[SceneFiles], str]:
    """What a process does with each scene; `alone` if it is ours."""
    if not alone:
        cv2.setNumThreads(1)
    return partial(_try_scene, label_map, settings, parts)


def _checked(
    make: Callable[[], Callable[[SceneFiles], str]],
    parts: SceneParts,
    recipe_sha256: str,
    versions: dict[str, str],
) -> Callable[[SceneFiles], str]:
    """A worker on another machine, which must see the parts and have the same libraries."""
    parts.check_there(recipe_sha256)
    if (here := _versions()) != versions:
        raise DataError(f"{platform.node()} has {here}, and this machine {versions}")
    return make()


def _try_scene(
    label_map: LabelMap, settings: Extraction, parts: SceneParts, files: SceneFiles
) -> str:
    """Extract a scene and write its part; else why there is none. Raises if it cannot write."""
    try:
        result = extract_scene(files, label_map, settings)
    except Qs3Error as error:
        return str(error)
    except MemoryError:
        return "out of memory"
    except Exception as error:  # one odd scene must not stop a thousand
        log.exception("%s: unexpected error", files.scene)
        return f"unexpected {type(error).__name__}: {error}"
    parts.save(result)
    return ""


def _results(
    make_worker: Callable[[], Callable[[SceneFiles], str]],
    parts: SceneParts,
    scenes: Sequence[SceneFiles],
    pool: Pool,
) -> list[SceneResult]:
    """One a scene, by name: from the parts, which are made where they are not there yet."""
    tasks = [(files.scene, files) for files in scenes if not parts.done(files)]
    total = len(scenes)
    failed = {}
    with progress_bar("scenes", total=total, done=total - len(tasks)) as advance:
        for outcome in pool.run(make_worker, tasks):
            if reason := _DIED if outcome.died else outcome.result:
                log.warning("%s: %s", outcome.name, reason)
                failed[outcome.name] = reason
            advance()
    parts.tidy()
    return [
        SceneResult(files, reason=failed[files.scene])
        if files.scene in failed
        else parts.load(files)
        for files in scenes
    ]


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
        first = next((r for r in results if r.reason), None)
        why = f"; the first that failed: {first.files.scene}: {first.reason}" if first else ""
        raise DataError(f"no object of {counted(len(results), 'scene')} gave a cloud{why}")
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
    rows: list[Sequence[Any]] = [_COLUMNS]
    for result in results:
        clouds = [one.cloud for one in result.objects if one.cloud is not None]
        digest = hashlib.sha256()
        for one in result.objects:
            digest.update(repr((one.labelled, one.frames, one.reason)).encode())
            digest.update(b"" if one.cloud is None else one.cloud.tobytes())
        notes = "; ".join([result.reason, *result.notes] if result.reason else result.notes)
        values = [
            result.files.scene, result.files.split, "failed" if result.reason else "ok",
            len(result.objects), len(clouds), result.frames, result.frames_used,
            result.frames_lost, result.frames_unmasked, digest.hexdigest()[:16],
            " ".join(notes.replace(f"{scans}/", "").splitlines()),
        ]  # fmt: skip
        rows.append(values)
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
    lost = counted(sum(r.frames_lost for r in results), "frame was", "frames were")
    log.info("%s left out for their pose", lost)
    failed = [result for result in results if result.reason]
    for result in failed[:_FAILURES_SHOWN]:
        log.warning("failed: %s: %s", result.files.scene, result.reason)
    if failed:
        advice = "repair or download them and run the same command again"
        log.warning("%d of %d scenes failed (%s); %s", len(failed), len(results), SCENES, advice)
    log.info("in %s, content hash %s", out, pointset.sha256[:16])
