"""Scenes in several processes; a scene that fails, or kills its process, costs only itself."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2

from qs3.data.scannet.files import SceneFiles
from qs3.data.scannet.labels import LabelMap
from qs3.data.scannet.scene import extract_scene
from qs3.data.scannet.scene_parts import SceneParts
from qs3.data.scannet.settings import Extraction
from qs3.errors import Qs3Error
from qs3.utils.pool import engine

log = logging.getLogger(__name__)

DIED = "the worker process died twice on this scene (out of memory, or a crash)"


@dataclass(frozen=True)
class Job:
    """What every worker needs to know once."""

    label_map: LabelMap
    settings: Extraction
    parts: SceneParts


@dataclass(frozen=True)
class Done:
    """A scene that was tried: its part is written, or `reason` says why there is none."""

    scene: str
    reason: str = ""


def try_scene(job: Job, files: SceneFiles) -> Done:
    """Extract a scene and write its part.

    Raises:
        Qs3Error: the part cannot be written; it would be the same with every scene.
    """
    try:
        result = extract_scene(files, job.label_map, job.settings)
    except Qs3Error as error:
        reason = str(error)
    except MemoryError:
        reason = "out of memory"
    except Exception as error:  # one odd scene must not stop a thousand
        log.exception("%s: unexpected error", files.scene)
        reason = f"unexpected {type(error).__name__}: {error}"
    else:
        job.parts.save(result)
        return Done(files.scene)
    return Done(files.scene, reason)


def all_scenes(job: Job, scenes: Sequence[SceneFiles], workers: int) -> Iterator[Done]:
    """Extract scenes; says of each when it is done.

    Args:
        job: what to do.
        scenes: with which scenes.
        workers: processes; 0 works in this one (for tests and debuggers).
    """
    tasks = ((files.scene, files) for files in scenes)
    for outcome in engine(workers).run(partial(_extractor, job, alone=workers == 0), tasks):
        yield outcome.result or Done(outcome.name, DIED)


def _extractor(job: Job, alone: bool) -> Callable[[SceneFiles], Done]:
    if not alone:
        cv2.setNumThreads(1)
    return partial(try_scene, job)
