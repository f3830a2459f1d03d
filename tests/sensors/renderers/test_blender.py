import json
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from qs3.errors import RenderError
from qs3.sensors.renderers import blender
from qs3.sensors.renderers.blender import BlenderRenderer, Device, choose, list_gpus
from qs3.sensors.renderers.blender_process import blender as make_blender
from tests.sensors.renderers.scenes import busy_camera, busy_scene


def test_missing_bpy_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(RenderError, match="bpy"):
        BlenderRenderer()


@pytest.mark.blender
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
@pytest.mark.blender
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


@pytest.mark.blender
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


@pytest.fixture
def elsewhere():
    return make_blender(samples=2, device="cpu", python=sys.executable)


@pytest.mark.blender
def test_another_interpreter_renders_the_same_bytes(elsewhere):
    here = BlenderRenderer(samples=2, device="cpu")
    assert elsewhere.provenance() == here.provenance()
    cameras, more = [busy_camera(), busy_camera()], {"seed": 3, "geometry": [True, False]}
    for a, b in zip(
        *(r.render(busy_scene(), cameras, **more) for r in (here, elsewhere)), strict=True
    ):
        for name in ("radiance", "depth_m", "label", "cosine"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with pytest.raises(ValueError, match="shorter"):  # what is raised there
        elsewhere.render(busy_scene(), cameras, seed=0, geometry=[True])


@pytest.mark.blender
def test_a_process_that_died_is_replaced(elsewhere):
    elsewhere._process.kill()
    elsewhere._process.wait()
    (image,) = elsewhere.render(busy_scene(), [busy_camera()], seed=0, geometry=[False])
    elsewhere._process.send_signal(signal.SIGSTOP)
    killer = threading.Timer(0.2, elsewhere._process.kill)
    killer.start()
    with pytest.raises(EOFError, match="ended"):
        elsewhere.render(busy_scene(), [busy_camera()], seed=0, geometry=[False])
    killer.join()
    (again,) = elsewhere.render(busy_scene(), [busy_camera()], seed=0, geometry=[False])
    np.testing.assert_array_equal(image.radiance, again.radiance)


def test_an_interpreter_without_blender_says_so(tmp_path):
    bare = tmp_path / "python"
    bare.symlink_to(sys.executable)  # outside its environment, so without its packages
    for python in (bare, "/nowhere"):
        with pytest.raises(RenderError):
            make_blender(python=str(python))
