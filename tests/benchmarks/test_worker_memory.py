"""What a worker process needs in memory over 200 objects: by Mitsuba with the paper's five views.

python -m pytest tests/benchmarks/test_worker_memory.py -m slow -s
python -m tests.benchmarks.test_worker_memory mitsuba 4 5 200    (samples, views, objects)
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from qs3.catalogue import Catalogue
from qs3.generation.camera_poses import AnchoredViews
from qs3.generation.recipes import Mesh2Point
from qs3.generation.workers import Job, scan_one
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Renderer
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

MAKE = {"mitsuba": MitsubaRenderer, "blender": BlenderRenderer}


def resident_mb() -> float:
    """Resident memory of this process, now."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(name: str, samples: int, views: int, objects: int) -> list[float]:
    """Resident memory in MB after each object, in this process, which does what a worker does."""

    def make() -> Renderer:
        return MAKE[name](samples=samples)

    recipe = Mesh2Point(SpeckleStereo(), views=AnchoredViews(count=views))
    job, renderer = Job(recipe, make, seed=0), make()
    items = Catalogue(seed=1, train=100, test=20).items()
    # All classes from the beginning, so that the largest objects do not come at the end.
    order = np.random.default_rng(0).permutation(len(items))[:objects]
    used = []
    for index in order:
        outcome = scan_one(job, renderer, items[index])
        assert outcome.cloud is not None, outcome.reason
        used.append(resident_mb())
    return used


# Blender's memory is the scene's, not the samples': one sample and two views keep it short.
@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("name", "samples", "views"), [("mitsuba", 4, 5), ("blender", 1, 2)], ids=["mitsuba", "blender"]
)
def test_memory_of_a_worker(name, samples, views, capsys):
    command = [
        sys.executable,
        "-m",
        "tests.benchmarks.test_worker_memory",
        name,
        str(samples),
        str(views),
        "200",
    ]
    child = subprocess.run(command, capture_output=True, text=True, check=True)
    used = json.loads(child.stdout.splitlines()[-1])
    # The median of twenty objects: a single one shows how large its own images are.
    early, late = np.median(used[10:30]), np.median(used[180:200])
    with capsys.disabled():
        curve = ", ".join(f"{i}: {used[i - 1]:.0f}" for i in (1, 20, 50, 100, 150, 200))
        print(  # noqa: T201
            f"\n{name}, {samples} samples, {views} views; MB after n objects: {curve}; "
            f"{late / early - 1:+.1%} from objects 11-30 to 181-200, at most {max(used):.0f}"
        )
    assert late < 1.05 * early
    assert max(used) < 2000


if __name__ == "__main__":
    chosen, *numbers = sys.argv[1:]
    sys.stdout.write(json.dumps(measure(chosen, *map(int, numbers))) + "\n")
