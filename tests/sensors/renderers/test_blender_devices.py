import numpy as np
import pytest

from qs3.errors import RenderError
from qs3.sensors.renderers import blender_devices
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.blender_devices import Device, choose
from tests.sensors.renderers.scenes import busy_camera, busy_scene


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
    gpus = blender_devices.list_gpus(renderer._bpy)
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
    assert renderer.provenance()["variant"] == renderer.device.variant


def test_the_cpu_where_it_is_asked_for_and_an_error_where_a_gpu_is_gone():
    renderer = BlenderRenderer(samples=1, device="cpu")
    assert renderer.provenance()["variant"] == "cycles_cpu"
    (image,) = renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[True])
    assert np.isfinite(image.depth_m).any()
    renderer.device = Device("CUDA", "none of this name")
    with pytest.raises(RenderError, match="none of this name"):
        renderer.render(busy_scene(), [busy_camera()], seed=0, geometry=[True])
