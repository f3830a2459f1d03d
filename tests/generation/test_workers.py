"""The pool: order, failures of objects, and workers that die.

Each worker imports this file: it imports no heavy library.
"""

import os
import signal
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from qs3.errors import MeshError, RenderError
from qs3.generation.kept import DiskError
from qs3.generation.recipes import Cloud
from qs3.generation.workers import DIED, Job, renderer_provenance, scan_all
from qs3.meshes.mesh import Mesh, MeshItem
from qs3.utils.pool import Processes


def mesh():
    return Mesh(np.eye(3), np.array([[0, 1, 2]]))


def unreadable():
    raise MeshError("chair_3.off: no faces")


def no_renderer():
    return None


@dataclass(frozen=True)
class Moody:
    """A recipe that kills the process for some objects, as a crashing renderer would."""

    deadly: str = "deadly"
    points: int = 4
    needs_renderer: bool = False

    def make(self, mesh, object_id, seed, renderer, keep=None):
        if self.deadly in object_id:
            os.kill(os.getpid(), signal.SIGKILL)
        if "dark" in object_id:
            raise RenderError("the renderer gave no image")
        if "full" in object_id:
            raise DiskError("cannot write view_0.npz: No space left on device")
        if "odd" in object_id:
            raise ZeroDivisionError("a defect")
        value = float(sum(map(ord, object_id)) + seed)
        return Cloud({"points": np.full((4, 3), value, np.float32)}, 1, 4)


def items(*names):
    return [MeshItem(name, "chair", "train", mesh, name) for name in names]


JOB = Job(Moody(), no_renderer, seed=3)


@pytest.mark.parametrize("workers", [0, 1])
def test_failures_of_objects_are_outcomes(workers):
    bad = MeshItem("bad", "chair", "train", unreadable, "bad")
    outcomes = {
        o.item_id: o
        for o in scan_all(JOB, [*items("a", "odd", "dark", "b"), bad], Processes(workers))
    }
    assert outcomes["a"].cloud is not None
    assert outcomes["b"].cloud.arrays["points"][0, 0] == ord("b") + 3
    assert outcomes["bad"].reason == "chair_3.off: no faces"
    assert outcomes["dark"].reason == "the renderer gave no image"
    assert outcomes["odd"].reason == "unexpected ZeroDivisionError: a defect"
    assert len(outcomes["a"].mesh_sha256) == 64


def test_a_full_disk_is_not_the_objects_fault():
    """It stops the run, from any process, and does not become one object's failure."""
    for workers in (0, 1):
        with pytest.raises(DiskError):
            list(scan_all(JOB, items("a", "full", "b"), Processes(workers)))


def test_an_object_that_kills_its_worker_costs_only_itself():
    names = ["a", "deadly", "b"]
    outcomes = {o.item_id: o for o in scan_all(JOB, items(*names), Processes(1))}
    assert set(outcomes) == set(names)
    assert outcomes.pop("deadly").reason == DIED
    assert all(o.cloud is not None for o in outcomes.values())


@pytest.mark.slow
def test_if_every_object_kills_its_worker_it_is_not_the_objects():
    with pytest.raises(RenderError):
        list(
            scan_all(Job(Moody(deadly=""), no_renderer, 0), items("a", "b", "c", "d"), Processes(1))
        )


def die(exit_code):
    os._exit(exit_code)


@dataclass(frozen=True)
class NeedsRenderer(Moody):
    needs_renderer: bool = True


def test_a_renderer_that_cannot_start_is_an_error():
    with pytest.raises(RenderError):
        renderer_provenance(Job(NeedsRenderer(), partial(die, 3), 0), Processes(1))
