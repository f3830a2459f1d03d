import json
import os
import subprocess
import sys

import numpy as np
import pytest

from qs3.errors import RenderError
from qs3.sensors.renderers import blender
from qs3.sensors.renderers.blender import BlenderRenderer, Device, choose, list_gpus
from tests.sensors.renderers.scenes import busy_camera, busy_scene


def test_missing_bpy_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(RenderError, match="bpy"):
        BlenderRenderer()


def test_failure_inside_blender_is_reported(monkeypatch):
    def fail(*_args):
        raise RuntimeError("Error: cannot save")

    monkeypatch.setattr(blender, "_aim", fail)
    renderer = BlenderRenderer(samples=1)
    with pytest.raises(RenderError, match="cannot save"):
        renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[True])
    monkeypatch.undo()
    (image,) = renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[True])
    assert np.isfinite(image.depth_m).any()


_ALONE = """
import json, os, sys
from qs3.sensors.renderers.blender import BlenderRenderer, Device, choose, list_gpus
from tests.sensors.renderers.scenes import busy_camera, busy_scene
before = os.sched_getaffinity(0)
renderer = BlenderRenderer(samples=1, threads=int(sys.argv[1]))
renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[False])
threads = os.listdir("/proc/self/task")
bound = [thread for thread in threads if os.sched_getaffinity(int(thread)) != before]
print(json.dumps([len(threads), bound]))
"""


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs Linux and two processors",
)
@pytest.mark.slow
def test_one_thread_starts_no_helpers():
    """Blender's idle helpers wait in a busy loop, and took a second worker's processor."""
    found = []
    for threads in ("1", "0"):
        child = subprocess.run(
            [sys.executable, "-c", _ALONE, threads], capture_output=True, text=True
        )
        assert child.returncode == 0, child.stderr
        count, bound = json.loads(child.stdout.splitlines()[-1])
        assert bound == []  # loading binds the process to one processor, and this is undone
        found.append(count)
    assert found[0] < found[1]


@pytest.mark.parametrize(
    ("wanted", "listed", "expected"),
    [
        ("cpu", {"OPTIX": ["A"], "CUDA": ["A"]}, Device()),
        ("auto", {"OPTIX": ["A"], "CUDA": ["A"]}, Device("OPTIX", "A")),
        ("auto", {"OPTIX": [], "CUDA": ["B", "C"]}, Device("CUDA", "B")),
        ("gpu", {"CUDA": ["B"]}, Device("CUDA", "B")),
        ("auto", {"OPTIX": [], "CUDA": []}, Device()),
        ("auto", {}, Device()),
    ],
)
def test_choice(wanted, listed, expected):
    assert choose(wanted, listed) == expected


def test_what_blender_really_lists():
    """With a GPU: it is found, used, and named. Without: the CPU, and an error that says so."""
    renderer = BlenderRenderer(samples=1)
    gpus = list_gpus(renderer._bpy)
    assert set(gpus) == {"OPTIX", "CUDA"}  # what the wheels for Linux and Windows are built with
    if any(gpus.values()):
        assert renderer.device == BlenderRenderer(samples=1, device="gpu").device
        assert renderer.provenance()["device"] == renderer.device.name
        assert renderer.device.backend != "CPU"
    else:
        assert renderer.device == Device()
        assert "device" not in renderer.provenance()
        with pytest.raises(RenderError, match="GPU"):
            BlenderRenderer(samples=1, device="gpu")
