"""Many objects, several processes: a recipe run over meshes, here or on other machines.

Each worker process makes its renderer once (Blender and Mitsuba are one a process) and is
replaced after a few hundred objects, because their memory creeps. An object that kills its
worker each time is reported as failed. What became of an object is saved as a part of the
unfinished dataset (`qs3.store.parts`), by the worker where it can.
"""

import hashlib
import logging
import os
import platform
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, MeshError, MeshUnavailableError, Qs3Error, RenderError
from qs3.generation.kept import DiskError, Keep
from qs3.generation.plan import code_fingerprint
from qs3.generation.recipes import Cloud, Found, Recipe
from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh, MeshItem
from qs3.sensors.renderers.base import Renderer
from qs3.store.parts import PartFiles
from qs3.utils.pool import Pool, Processes

log = logging.getLogger(__name__)

COLLIDERS = "colliders left out"
"""Begins the note of an object that had some."""
DIED = "the worker process died on this object each time (out of memory, or a crash)"
_DEATHS = 3  # objects in a row
_LIBRARIES = ("numpy", "opencv-python-headless", "mitsuba", "drjit", "trimesh")


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one object.

    A failure is lasting if the object is to blame, and not the machine or a defect of ours; others
    are tried again at the next start.
    """

    item_id: str
    mesh_sha256: str  # of the mesh as loaded; empty if it could not be
    cloud: Cloud | None  # None if it failed; without its frames
    reason: str  # why it failed; empty if it did not
    lasting: bool = True
    unavailable: bool = False  # its mesh is there no more: the dataset is not finished without it
    note: str = ""  # what else its manifest row should state of an object that did not fail
    saved: bool = False  # by the worker (`Job.save`); then `cloud` is None here


@dataclass(frozen=True)
class Job:
    """What every worker needs to know once; picklable.

    A worker process saves lasting outcomes itself, so that what is done is on disk whatever happens
    to the others.
    """

    recipe: Recipe
    make_renderer: Callable[[], Renderer]  # called once in each worker if the recipe needs one
    seed: int  # of the dataset
    keep: Keep = field(default_factory=Keep)
    save: Callable[[Outcome], None] | None = None
    expected: Mapping[str, str] | None = None  # of workers elsewhere: libraries, code, renderer
    check_place: Callable[[], None] | None = None  # likewise; raises where `save` would be lost


def scan_one(job: Job, renderer: Renderer | None, item: MeshItem) -> Outcome:
    """Make one object's cloud; failures of the object become an Outcome, not an error."""
    sha256, lasting, unavailable = "", True, False
    try:
        mesh = item.load()  # of a room the split
        sha256, hidden = getattr(mesh, "sha256", ""), getattr(mesh, "colliders", 0)
        cloud = job.recipe.make(mesh, item.id, job.seed, renderer, job.keep)
        note = f"{COLLIDERS}: {hidden}" if hidden else ""
        return Outcome(item.id, sha256, replace(cloud, frames=()), "", note=note)
    except DiskError:
        raise
    except MeshUnavailableError as error:  # it was there when its content was hashed
        reason, lasting, unavailable = str(error), False, True
    except Qs3Error as error:
        reason = str(error)
    except Exception as error:  # one odd mesh must not stop thousands
        log.exception("%s: unexpected error", item.id)
        reason, lasting = f"unexpected {type(error).__name__}: {error}", False
    return Outcome(item.id, sha256, None, reason, lasting, unavailable)


def save_part(parts: PartFiles, outcome: Outcome) -> None:
    """Write one outcome, atomically."""
    cloud = outcome.cloud
    note: dict[str, Any] = {
        key: getattr(outcome, key) for key in ("item_id", "mesh_sha256", "reason", "note")
    }
    for key in ("views", "valid_points"):
        note[key] = getattr(cloud, key) if cloud else 0
    note["found"] = cloud.found if cloud else None
    parts.write(_name(outcome.item_id), note, cloud.arrays if cloud else {})


def load_part(parts: PartFiles, item_id: str) -> Outcome:
    """One outcome; its arrays stay on disk until they are asked for."""
    note, arrays = parts.read(_name(item_id))
    views, points, found = (note.pop(key) for key in ("views", "valid_points", "found"))
    found = found if found is None else tuple(Found(*row) for row in found)
    cloud = Cloud(arrays, views, points, found=found) if arrays or found == () else None
    return Outcome(cloud=cloud, **note)


def has_part(parts: PartFiles, item_id: str) -> bool:
    """Whether an outcome is saved."""
    return parts.has(_name(item_id))


def _name(item_id: str) -> str:
    """Name of a part's file: ids are longer than names of files may be."""
    return hashlib.sha256(item_id.encode()).hexdigest()[:32]


def renderer_provenance(job: Job, pool: Pool) -> dict[str, str]:
    """Renderer, variant and versions, asked in a child process unless the scans are made here."""
    if not job.recipe.needs_renderer:
        return {}
    inspect = partial(_inspector, job)
    (outcome,) = Processes(min(pool.at_once, 1)).run(inspect, [("renderer", None)])
    if outcome.result is None:
        raise RenderError("the renderer's process died at its start: see `qs3 doctor`")
    provenance, found_out = outcome.result
    # What the child found out about this machine need not be found out by every worker.
    os.environ.update(found_out)
    return provenance


def scan_all(job: Job, items: list[MeshItem], pool: Pool) -> Iterator[Outcome]:
    """Outcomes in the order in which they are done."""
    deaths = 0
    if not pool.shared_disk:
        items = _sent(items, keep_views=job.keep.view is not None)
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
        if self.job.check_place:
            self.job.check_place()
        self.save(outcome)
        return replace(outcome, cloud=None, saved=True)


def _inspector(job: Job) -> Callable[[None], tuple[dict[str, str], dict[str, str]]]:
    """A worker that reports its renderer and what it found out about the machine."""
    renderer = job.make_renderer()

    def inspect(_: None) -> tuple[dict[str, str], dict[str, str]]:
        found_out = {name: value for name, value in os.environ.items() if name.startswith("QS3_")}
        return renderer.provenance(), found_out

    return inspect


def software() -> dict[str, str]:
    """What else of this machine, besides the renderer, decides the bytes of a cloud."""
    return {
        **{name: version(name) for name in _LIBRARIES},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "qs3's code": code_fingerprint()[:12],
    }


def check_software(expected: Mapping[str, str], found: Mapping[str, str]) -> None:
    """Raise RenderError where this machine's clouds would not be those of the command's."""
    names = sorted({*expected, *found})
    if differs := [name for name in names if found.get(name) != expected.get(name)]:
        pairs = ", ".join(f"{name} ({found.get(name)}, {expected.get(name)})" for name in differs)
        raise RenderError(
            f"{platform.node()} would make other clouds than the machine of the command: {pairs}"
        )


def _sent(items: Sequence[MeshItem], keep_views: bool) -> list[MeshItem]:
    """Items that take the bytes of their files along, for machines that do not see the files."""
    if keep_views or any(item.path and item.path.suffix.lower() == ".gltf" for item in items):
        raise ConfigError(
            "keep_views=true, and meshes in several files (.gltf), need a disk that all nodes see: "
            "engine.shared_disk=true"
        )
    return [replace(item, load=_Sent(item)) if item.path else item for item in items]


class _Sent:
    """Loads a mesh wherever it is called; what is pickled holds the file's content."""

    def __init__(self, item: MeshItem) -> None:
        assert item.path is not None
        assert isinstance(item.load, partial)
        self.path, self.settings = item.path, item.load.keywords
        self.content: bytes | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Read when it is sent, not before: there may be many."""
        return {**self.__dict__, "content": self.path.read_bytes()}

    def __call__(self) -> Mesh:
        if self.content is None:
            return load_mesh(self.path, **self.settings)
        with tempfile.TemporaryDirectory(prefix="qs3-mesh-") as folder:
            copy = Path(folder) / self.path.name
            copy.write_bytes(self.content)
            try:
                return load_mesh(copy, **self.settings)
            except MeshError as error:  # a manifest is the same wherever objects were scanned
                raise MeshError(str(error).replace(folder, str(self.path.parent))) from error
