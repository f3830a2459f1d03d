"""Many objects, several processes: the pool that runs a recipe over meshes.

Each worker process makes its renderer once (Blender and Mitsuba are one a process) and is
replaced after a few hundred objects, because their memory creeps. A worker that dies takes
nothing with it: what was in flight is tried again, one object at a time, and an object that
kills its worker twice is reported as failed.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

from qs3.errors import Qs3Error, RenderError
from qs3.generation.provenance import Keep
from qs3.generation.recipes import Cloud, Recipe
from qs3.generation.view_files import DiskError, disk_errors_travel
from qs3.meshes.source import MeshItem
from qs3.sensors.renderers.base import Renderer

log = logging.getLogger(__name__)

OBJECTS_PER_WORKER = 200
DIED = "the worker process died twice on this object (out of memory, or a crash)"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one object.

    Attributes:
        item_id: of the mesh item.
        mesh_sha256: of the mesh as loaded; empty if it could not be.
        cloud: None if it failed; without its frames.
        reason: why it failed; empty if it did not.
        lasting: whether it would fail again: the object is to blame, and not the machine or a
            defect of ours. Other failures are tried again at the next start.
        note: what else its manifest row should say of an object that did not fail.
        saved: the worker has saved it (`Job.save`); then `cloud` is None here.
    """

    item_id: str
    mesh_sha256: str
    cloud: Cloud | None
    reason: str
    lasting: bool = True
    note: str = ""
    saved: bool = False


@dataclass(frozen=True)
class Job:
    """What every worker needs to know once.

    Attributes:
        recipe: how a cloud is made.
        make_renderer: picklable; called once in each worker if the recipe needs one.
        seed: of the dataset.
        keep: what is wanted besides the clouds.
        save: picklable; a worker process saves lasting outcomes by it. Clouds must not come back
            through the pool's pipe: a worker killed in the middle of a large message leaves half
            of it there, and the pool waits for the rest for ever.
    """

    recipe: Recipe
    make_renderer: Callable[[], Renderer]
    seed: int
    keep: Keep = field(default_factory=Keep)
    save: Callable[[Outcome], None] | None = None


def scan_one(job: Job, renderer: Renderer | None, item: MeshItem) -> Outcome:
    """Make one object's cloud; failures of the object become an Outcome, not an error.

    Raises:
        DiskError: the views cannot be written; it would be the same with every object.
    """
    sha256, lasting = "", True
    try:
        mesh = item.load()
        sha256 = mesh.sha256
        cloud = job.recipe.make(mesh, item.id, job.seed, renderer, job.keep)
        note = f"colliders left out: {mesh.colliders}" if mesh.colliders else ""
        return Outcome(item.id, sha256, replace(cloud, frames=()), "", note=note)
    except DiskError:
        raise
    except Qs3Error as error:
        reason = str(error)
    except MemoryError:
        reason, lasting = "out of memory", False
    except Exception as error:  # one odd mesh must not stop thousands
        log.exception("%s: unexpected error", item.id)
        reason, lasting = f"unexpected {type(error).__name__}: {error}", False
    return Outcome(item.id, sha256, None, reason, lasting)


def renderer_provenance(job: Job) -> dict[str, str]:
    """Renderer, variant and versions, asked in a child process.

    Raises:
        RenderError: the renderer cannot be used here.
    """
    if not job.recipe.needs_renderer:
        return {}
    try:
        with _pool(job, 1) as pool:
            provenance, found_out = pool.submit(_provenance).result()
    except BrokenProcessPool as error:
        raise RenderError(
            "the renderer's process died at its start (out of memory, killed, or a library that "
            "does not fit): run again, and see `python -m qs3.tools.doctor` if it happens again"
        ) from error
    # What the child found out about this machine need not be found out by every worker.
    os.environ.update(found_out)
    return provenance


def scan_all(job: Job, items: list[MeshItem], workers: int) -> Iterator[Outcome]:
    """Outcomes in the order in which they are done.

    Args:
        job: what to do.
        items: with which meshes.
        workers: processes; 0 works in this one (for tests and debuggers).

    Raises:
        RenderError: one object after the other kills its worker; it is not the objects.
    """
    if workers == 0:
        renderer = job.make_renderer() if job.recipe.needs_renderer else None
        for item in items:
            yield scan_one(job, renderer, item)
        return
    chunk = OBJECTS_PER_WORKER * workers
    for first in range(0, len(items), chunk):
        left = {item.id: item for item in items[first : first + chunk]}
        try:
            for outcome in _scan_chunk(job, list(left.values()), workers):
                del left[outcome.item_id]
                yield outcome
        except BrokenProcessPool:
            log.warning("a worker process died; trying the objects that it had one at a time")
            alone = [_scan_alone(job, left[i]) for i in list(left)[: max(2 * workers, 3)]]
            survived = [outcome for outcome in alone if outcome.reason != DIED]
            if len(alone) > 2 and not survived:
                raise RenderError(
                    f"{len(alone)} objects in a row ended their worker process: this machine lacks "
                    "memory, or the renderer does not work here (python -m qs3.tools.doctor)"
                ) from None
            for outcome in alone:
                del left[outcome.item_id]
                yield outcome
            yield from scan_all(job, list(left.values()), workers)


def _scan_chunk(job: Job, items: list[MeshItem], workers: int) -> Iterator[Outcome]:
    pool = _pool(job, min(workers, len(items)))
    try:
        waiting = iter(items)
        running: set[Future[Outcome]] = set()
        while True:
            # Two a worker in flight: enough that none idles, few to repeat after a crash.
            while len(running) < 2 * workers and (item := next(waiting, None)) is not None:
                running.add(pool.submit(_scan, item))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            # In a broken pool every future fails: keep what was done before it broke.
            finished = [future for future in done if future.exception() is None]
            for future in finished:
                yield future.result()
            for future in done:
                future.result()
    finally:
        for process in list(pool._processes.values()):
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _scan_alone(job: Job, item: MeshItem) -> Outcome:
    try:
        with _pool(job, 1) as pool:
            return pool.submit(_scan, item).result()
    except BrokenProcessPool:
        return Outcome(item.id, "", None, DIED, lasting=False)


_JOB: Job | None = None
_RENDERER: Renderer | None = None


def _pool(job: Job, workers: int) -> ProcessPoolExecutor:
    # Spawned, because neither Blender nor a threaded BLAS survives a fork.
    return ProcessPoolExecutor(
        workers,
        mp_context=get_context("spawn"),
        initializer=_start_worker,
        initargs=(job, os.getpid()),
    )


def _start_worker(job: Job, parent: int) -> None:
    global _JOB
    _JOB = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()


def _die_with(parent: int) -> None:
    """A worker whose parent was killed would wait for work for ever."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _renderer() -> Renderer | None:
    global _RENDERER
    assert _JOB is not None
    if _RENDERER is None and _JOB.recipe.needs_renderer:
        _RENDERER = _JOB.make_renderer()
    return _RENDERER


def _provenance() -> tuple[dict[str, str], dict[str, str]]:
    renderer = _renderer()
    assert renderer is not None
    found_out = {name: value for name, value in os.environ.items() if name.startswith("QS3_")}
    return renderer.provenance(), found_out


def _scan(item: MeshItem) -> Outcome:
    assert _JOB is not None
    outcome = scan_one(_JOB, _renderer(), item)
    if _JOB.save is None or not outcome.lasting:
        return outcome
    with disk_errors_travel():
        _JOB.save(outcome)
    return replace(outcome, cloud=None, saved=True)
