"""On what Cycles renders: an NVIDIA GPU where Blender lists one, else the CPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from qs3.errors import RenderError

CHOICES = ("auto", "cpu", "gpu")
_BACKENDS = ("OPTIX", "CUDA")  # OptiX needs a newer driver and is faster


@dataclass(frozen=True)
class Device:
    """Where to render; each makes bytes of its own.

    Attributes:
        backend: "CPU", or Cycles' name of a GPU interface ("OPTIX", "CUDA").
        name: what Blender calls the GPU; empty for the CPU, whose kind changes no byte.
    """

    backend: str = "CPU"
    name: str = ""

    @property
    def variant(self) -> str:
        """As provenance names it: "cycles_cpu", "cycles_optix" or "cycles_cuda"."""
        return f"cycles_{self.backend.lower()}"


def choose(wanted: str, listed: dict[str, list[str]]) -> Device:
    """The device for one of `CHOICES`; `listed` are names of GPUs by backend, see `list_gpus`.

    Raises:
        RenderError: a GPU is wanted and none is listed.
    """
    assert wanted in CHOICES, f"renderer.device must be one of {CHOICES}"
    if wanted == "cpu":
        return Device()
    for backend in _BACKENDS:
        if listed.get(backend):
            # One is used: rendering on several splits the image, and worker processes share one.
            return Device(backend, listed[backend][0])
    if wanted == "gpu":
        raise RenderError("renderer.device=gpu: Blender lists no NVIDIA GPU for OptiX or CUDA")
    return Device()


def list_gpus(bpy: Any) -> dict[str, list[str]]:
    """Names of the GPUs that Blender can use here, by backend."""
    return {
        backend: [entry.name for entry in _entries(bpy, backend)]
        for backend in _BACKENDS
        if backend in _built_in(bpy)
    }


def use(bpy: Any, cycles: Any, device: Device) -> None:
    """Set Blender's preferences and a scene's Cycles to `device`; RenderError if it has gone."""
    if device.backend == "CPU":
        cycles.device = "CPU"
        return
    _preferences(bpy).compute_device_type = device.backend
    found = _entries(bpy, device.backend)
    if device.name not in (entry.name for entry in found):
        raise RenderError(f"Blender does not list {device.name} for {device.backend} any more")
    chosen = next(entry for entry in found if entry.name == device.name)
    for entry in _preferences(bpy).devices:
        entry.use = entry.id == chosen.id and entry.type == device.backend
    cycles.device = "GPU"


def _preferences(bpy: Any) -> Any:
    return bpy.context.preferences.addons["cycles"].preferences


def _built_in(bpy: Any) -> tuple[str, ...]:
    """Backends that this build of Blender was made with."""
    return tuple(item[0] for item in _preferences(bpy).get_device_types(bpy.context))


def _entries(bpy: Any, backend: str) -> list[Any]:
    """Blender's entries of all GPUs of a backend; it lists the CPU with them."""
    listed = _preferences(bpy).get_devices_for_type(backend)
    return [entry for entry in listed if entry.type == backend]
