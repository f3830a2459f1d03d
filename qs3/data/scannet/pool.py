"""Scenes in several processes; a scene that fails, or kills its process, costs only itself.

A worker writes the part of its scene itself and sends back a few words. A process that is killed
while it sends more than a pipe holds leaves half a message, and `ProcessPoolExecutor` waits for
the other half for ever.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context

import cv2

from qs3.data.scannet.files import SceneFiles
from qs3.data.scannet.labels import LabelMap
from qs3.data.scannet.scene import extract_scene
from qs3.data.scannet.scene_parts import SceneParts
from qs3.data.scannet.settings import Extraction
from qs3.errors import Qs3Error

log = logging.getLogger(__name__)

_LONGEST_REASON = 1000  # characters; with it, a message is written at one go
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
    return Done(files.scene, reason[:_LONGEST_REASON])


def all_scenes(job: Job, scenes: Sequence[SceneFiles], workers: int) -> Iterator[Done]:
    """Extract scenes; says of each when it is done.

    Args:
        job: what to do.
        scenes: with which scenes.
        workers: processes; 0 works in this one (for tests and debuggers).
    """
    if workers == 0:
        for files in scenes:
            yield try_scene(job, files)
        return
    left = {files.scene: files for files in scenes}
    while left:
        try:
            for done in _together(job, list(left.values()), workers):
                del left[done.scene]
                yield done
        except BrokenProcessPool:
            log.warning("a worker process died; trying the scenes that it had one at a time")
            for files in list(left.values())[: 2 * workers]:
                yield _alone(job, left.pop(files.scene))


def _together(job: Job, scenes: Sequence[SceneFiles], workers: int) -> Iterator[Done]:
    pool = _pool(job, min(workers, len(scenes)))
    try:
        waiting = iter(scenes)
        running: set[Future[Done]] = set()
        while True:
            # Two a worker in flight: enough that none idles, few to repeat after a crash.
            while len(running) < 2 * workers and (files := next(waiting, None)) is not None:
                running.add(pool.submit(_try, files))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            # In a broken pool every future fails: keep what was done before it broke.
            for future in done:
                if future.exception() is None:
                    yield future.result()
            for future in done:
                future.result()
    finally:
        for process in list(pool._processes.values()):
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _alone(job: Job, files: SceneFiles) -> Done:
    try:
        with _pool(job, 1) as pool:
            return pool.submit(_try, files).result()
    except BrokenProcessPool:
        return Done(files.scene, DIED)


_JOB: Job | None = None


def _pool(job: Job, workers: int) -> ProcessPoolExecutor:
    # Spawned, as OpenCV's threads do not survive a fork.
    return ProcessPoolExecutor(
        workers,
        mp_context=get_context("spawn"),
        initializer=_start_worker,
        initargs=(job, os.getpid()),
    )


def _start_worker(job: Job, parent: int) -> None:
    global _JOB
    _JOB = job
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()


def _die_with(parent: int) -> None:
    """A worker whose parent was killed would wait for work for ever."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _try(files: SceneFiles) -> Done:
    assert _JOB is not None
    return try_scene(_JOB, files)
