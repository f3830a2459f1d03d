"""Many objects, several processes: a recipe run over meshes.

Each worker process makes its renderer once (Blender and Mitsuba are one a process) and is
replaced after a few hundred objects, because their memory creeps. An object that kills its
worker each time is reported as failed.
"""

from __future__ import annotations

import logging
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from qs3.errors import MeshMemoryError, MeshUnavailableError, Qs3Error, RenderError
from qs3.generation.materials import MixedMaterials
from qs3.generation.provenance import Keep
from qs3.generation.recipes import Cloud, Recipe
from qs3.generation.travel import check_software, sent, software
from qs3.generation.view_files import DiskError, disk_errors_travel
from qs3.meshes.mesh import Mesh
from qs3.meshes.source import MeshItem
from qs3.sensors.renderers.base import Renderer
from qs3.utils.pool import Pool, Processes

log = logging.getLogger(__name__)

COLLIDERS = "colliders left out"
"""Begins the note of an object that had some."""
_DEATHS = 3  # objects in a row
DIED = "the worker process died on this object each time (out of memory, or a crash)"


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
        unavailable: its mesh is there no more: the dataset is not finished without it.
        note: what else its manifest row should say of an object that did not fail.
        saved: the worker has saved it (`Job.save`); then `cloud` is None here.
        seconds: that the scan took.
        memory_mb: the most that its process had taken by then.
    """

    item_id: str
    mesh_sha256: str
    cloud: Cloud | None
    reason: str
    lasting: bool = True
    unavailable: bool = False
    note: str = ""
    saved: bool = False
    seconds: float = 0.0
    memory_mb: float = 0.0


@dataclass(frozen=True)
class Job:
    """What every worker needs to know once.

    Attributes:
        recipe: how a cloud is made.
        make_renderer: picklable; called once in each worker if the recipe needs one.
        seed: of the dataset.
        keep: what is wanted besides the clouds.
        save: picklable; a worker process saves lasting outcomes by it, so that what is done is
            on disk whatever happens to the others.
        expected: for workers on other machines: libraries, code and renderer of this one.
        check_place: likewise; raises where `save` would not save for us.
    """

    recipe: Recipe
    make_renderer: Callable[[], Renderer]
    seed: int
    keep: Keep = field(default_factory=Keep)
    save: Callable[[Outcome], None] | None = None
    expected: Mapping[str, str] | None = None
    check_place: Callable[[], None] | None = None


def scan_one(job: Job, renderer: Renderer | None, item: MeshItem) -> Outcome:
    """Make one object's cloud; failures of the object become an Outcome, not an error.

    Raises:
        DiskError: the views cannot be written; it would be the same with every object.
    """
    begin = time.perf_counter()
    outcome = _scan(job, renderer, item)
    seconds = time.perf_counter() - begin
    # In kilobytes, on macOS in bytes.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak_mb = peak / (2**20 if sys.platform == "darwin" else 2**10)
    return replace(outcome, seconds=round(seconds, 3), memory_mb=round(peak_mb, 1))


def _scan(job: Job, renderer: Renderer | None, item: MeshItem) -> Outcome:
    sha256, lasting, unavailable = "", True, False
    try:
        mesh = item.load()
        sha256 = mesh.sha256
        cloud = job.recipe.make(mesh, item.id, job.seed, renderer, job.keep)
        return Outcome(item.id, sha256, replace(cloud, frames=()), "", note=_note(job, mesh))
    except DiskError:
        raise
    except MeshUnavailableError as error:  # it was there when its content was hashed
        reason, lasting, unavailable = str(error), False, True
    except MeshMemoryError as error:
        reason, lasting = str(error), False
    except Qs3Error as error:
        reason = str(error)
    except MemoryError:
        reason, lasting = "out of memory", False
    except Exception as error:  # one odd mesh must not stop thousands
        log.exception("%s: unexpected error", item.id)
        reason, lasting = f"unexpected {type(error).__name__}: {error}", False
    return Outcome(item.id, sha256, None, reason, lasting, unavailable)


def _note(job: Job, mesh: Mesh) -> str:
    """What a manifest should say of an object that was made."""
    notes = [f"{COLLIDERS}: {mesh.colliders}"] * bool(mesh.colliders)
    materials: MixedMaterials | None = getattr(job.recipe, "materials", None)
    notes += [materials.note(mesh)] if materials is not None else []
    return "; ".join(filter(None, notes))


def renderer_provenance(job: Job) -> dict[str, str]:
    """Renderer, variant and versions, asked in a child process.

    Raises:
        RenderError: the renderer cannot be used here.
    """
    if not job.recipe.needs_renderer:
        return {}
    (outcome,) = Processes(1).run(partial(_Inspector, job), [("renderer", None)])
    if outcome.result is None:
        raise RenderError(
            "the renderer's process died at its start (out of memory, killed, or a library that "
            "does not fit): run again, and see `qs3 doctor` if it happens again"
        )
    provenance, found_out = outcome.result
    # What the child found out about this machine need not be found out by every worker.
    os.environ.update(found_out)
    return provenance


def scan_all(job: Job, items: list[MeshItem], pool: Pool) -> Iterator[Outcome]:
    """Outcomes in the order in which they are done.

    Args:
        job: what to do.
        items: with which meshes.
        pool: who does it.

    Raises:
        RenderError: one object after the other kills its worker, it is not the objects; or a
            machine of the pool would make other clouds.
        ConfigError: meshes or views cannot be sent between machines without a disk in common.
    """
    deaths = 0
    if not pool.shared_disk:
        items = sent(items, keep_views=job.keep.views is not None)
    make_worker = partial(_Scanner, job, saves=pool.shared_disk and pool.at_once > 0)
    tasks = ((item.id, item) for item in items)
    for outcome in pool.run(make_worker, tasks):
        deaths = deaths + 1 if outcome.died else 0
        # Each worker can meet a deadly object at the same time; as many again are too many.
        if deaths == min(max(2 * pool.at_once, _DEATHS), max(len(items), _DEATHS)):
            raise RenderError(
                f"{deaths} objects in a row ended their worker process: this machine lacks "
                "memory, or the renderer does not work here (qs3 doctor)"
            )
        yield outcome.result or Outcome(outcome.name, "", None, DIED, lasting=False)


class _Scanner:
    """A worker: scans objects with a renderer of its own."""

    def __init__(self, job: Job, saves: bool) -> None:
        if job.check_place:
            job.check_place()
        self.job = job
        self.save = job.save if saves else None
        self.renderer = job.make_renderer() if job.recipe.needs_renderer else None
        if job.expected is not None:
            renderer = self.renderer.provenance() if self.renderer else {}
            check_software(job.expected, {**software(), **renderer})

    def __call__(self, item: MeshItem) -> Outcome:
        outcome = scan_one(self.job, self.renderer, item)
        if self.save is None or not outcome.lasting:
            return outcome
        with disk_errors_travel():
            if self.job.check_place:
                self.job.check_place()
            self.save(outcome)
        return replace(outcome, cloud=None, saved=True)


class _Inspector:
    """A worker that says which renderer it has, and what it has learnt about the machine."""

    def __init__(self, job: Job) -> None:
        self.renderer = job.make_renderer()

    def __call__(self, _: None) -> tuple[dict[str, str], dict[str, str]]:
        found_out = {name: value for name, value in os.environ.items() if name.startswith("QS3_")}
        return self.renderer.provenance(), found_out
