import pytest

from qs3.errors import RenderError
from qs3.sensors.renderers import blender_devices
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.blender_devices import Device, choose


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
