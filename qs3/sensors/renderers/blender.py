"""Blender's Cycles, on the CPU or a GPU: the renderer of the paper, our reference.

The only place that imports bpy. One process holds one Blender with global state; every call
builds its own data, renders, and removes it, so nothing is left for the next call. What this
module imports is the standard library, numpy and modules of ours that need no more: it also runs
in interpreters that have nothing but Blender (`blender_process`).
"""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import (
    Image,
    RendererSettings,
    Scene,
    give_memory_back,
    incidence,
)
from qs3.sensors.renderers.blender_scene import (
    add_area,
    add_body,
    add_projector,
    blender_pose,
    cast_shadow_by_copy,
    show_camera_only,
)
from qs3.utils.pool import portable

_BACKENDS = ("OPTIX", "CUDA")  # OptiX needs a newer driver and is faster
_BACKGROUND_M = 1e9  # Cycles writes 1e10 m where nothing is hit


@dataclass(frozen=True)
class Device:
    """Where to render; each makes bytes of its own.

    Attributes:
        backend: "CPU", or Cycles' name of a GPU interface ("OPTIX", "CUDA").
        name: what Blender calls the GPU; empty for the CPU, whose kind changes no byte.
    """

    backend: str = "CPU"
    name: str = ""


class BlenderRenderer:
    """A `Renderer` on Blender's Cycles."""

    def __init__(self, samples: int = 16, threads: int = 1, device: str = "auto") -> None:
        """Start Blender inside this process; see `blender_process.blender`."""
        self.settings = RendererSettings(samples, threads)
        with _one_cpu() if threads == 1 else nullcontext():
            self._bpy = _import_bpy()
        listed = {} if device == "cpu" else list_gpus(self._bpy)
        self.device = choose(device, listed)

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render every camera; see `Renderer.render`."""
        with tempfile.TemporaryDirectory(prefix="qs3-blender-") as folder:
            path = Path(folder) / "blender.log"
            try:
                with _quiet(path):
                    return self._render(scene, cameras, seed, geometry, Path(folder))
            except (RuntimeError, OSError) as error:
                tail = path.read_text(errors="replace")[-500:].strip() if path.exists() else ""
                raise RenderError(f"Blender failed: {error} {tail}".strip()) from error

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions; see `Renderer.provenance`."""
        found = {
            "renderer": "blender",
            "variant": f"cycles_{self.device.backend.lower()}",
            "bpy": self._bpy.app.version_string,
            "samples": str(self.settings.samples),
        }
        if self.device.name:
            found["device"] = self.device.name
        return found

    def _render(
        self, scene: Scene, cameras: list[Camera], seed: int, geometry: list[bool], folder: Path
    ) -> list[Image]:
        bpy = self._bpy
        # Takes some 20 ms, and undoes what other code of this process did to the global state.
        bpy.ops.wm.read_factory_settings(use_empty=True)
        target = bpy.context.scene
        _configure(target, self.settings)
        _use(bpy, target.cycles, self.device)
        try:
            bodies = [add_body(bpy, target, body, scene) for body in scene.bodies]
            lamps = []
            if scene.projector is not None:
                lamps.append(add_projector(bpy, target, scene.projector))
                lamps += [cast_shadow_by_copy(target, thing, scene.projector) for thing in bodies]
            eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
            target.collection.objects.link(eye)
            target.camera = eye
            images = self._photographs(target, eye, cameras, seed, geometry, folder)
            if scene.area is not None:
                # Apart: of several lights Cycles takes one at random for each sample.
                for thing in lamps:
                    thing.hide_render = True
                for thing in bodies:
                    show_camera_only(thing)
                    # Rays end on them, and so find the light where nothing is before it.
                    thing.visible_shadow = thing.visible_diffuse = thing.visible_glossy = True
                target.cycles.max_bounces = 1
                add_area(bpy, target, scene.area)
                none = [False] * len(cameras)
                more = self._photographs(target, eye, cameras, ~seed, none, folder)
                images = [
                    replace(image, radiance=image.radiance + other.radiance)
                    for image, other in zip(images, more, strict=True)
                ]
        finally:
            target.render.use_persistent_data = False
            _remove_everything(bpy)
            give_memory_back()
        return images

    def _photographs(
        self,
        target: Any,
        eye: Any,
        cameras: list[Camera],
        seed: int,
        geometry: list[bool],
        folder: Path,
    ) -> list[Image]:
        layer, images = target.view_layers[0], []
        for index, (camera, wanted) in enumerate(zip(cameras, geometry, strict=True)):
            _aim(target, eye, camera)
            layer.use_pass_z = layer.use_pass_object_index = layer.use_pass_normal = wanted
            # Cameras of one call must not share their sampling noise.
            target.cycles.seed = (seed + 0x9E3779B9 * index) % 2**31
            path = folder / f"{index}.exr"
            target.render.filepath = str(path)
            self._bpy.ops.render.render(write_still=True)
            images.append(_image(_read_exr(path), camera))
            path.unlink()
        return images


def serve(descriptor: int) -> None:
    """Render for the process at the other end of a pipe, until it closes that end."""
    pipe, renderer = Connection(descriptor), None
    with suppress(EOFError):
        while True:
            answer: Any
            question = pipe.recv()
            try:
                if renderer is None:
                    renderer = BlenderRenderer(**question)
                    answer = renderer.provenance()
                else:
                    answer = renderer.render(**question)
            except Exception as error:
                answer = portable(error)
            pipe.send(answer)


def choose(wanted: str, listed: dict[str, list[str]]) -> Device:
    """The device for "auto", "cpu" or "gpu"; `listed` are names of GPUs by backend."""
    for backend in _BACKENDS:
        if wanted != "cpu" and listed.get(backend):
            # One is used: rendering on several splits the image, and worker processes share one.
            return Device(backend, listed[backend][0])
    if wanted == "gpu":
        raise RenderError("renderer.device=gpu: Blender lists no NVIDIA GPU for OptiX or CUDA")
    return Device()


def list_gpus(bpy: Any) -> dict[str, list[str]]:
    """Names of the GPUs that Blender can use here, by each backend that it was built with."""
    built_in = [item[0] for item in _preferences(bpy).get_device_types(bpy.context)]
    return {
        backend: [entry.name for entry in _entries(bpy, backend)]
        for backend in _BACKENDS
        if backend in built_in
    }


def _use(bpy: Any, cycles: Any, device: Device) -> None:
    cycles.device = "CPU" if device.backend == "CPU" else "GPU"
    if cycles.device == "GPU":
        _preferences(bpy).compute_device_type = device.backend
        chosen = next(e for e in _entries(bpy, device.backend) if e.name == device.name)
        for entry in _preferences(bpy).devices:
            entry.use = entry.id == chosen.id and entry.type == device.backend


def _preferences(bpy: Any) -> Any:
    return bpy.context.preferences.addons["cycles"].preferences


def _entries(bpy: Any, backend: str) -> list[Any]:
    """Blender's entries of all GPUs of a backend; it lists the CPU with them."""
    listed = _preferences(bpy).get_devices_for_type(backend)
    return [entry for entry in listed if entry.type == backend]


def _import_bpy() -> Any:
    try:
        import bpy
    except ImportError as error:
        raise RenderError(
            f"Blender cannot be loaded ({error}); see `qs3 doctor`. renderer.python=PATH takes "
            "another interpreter's, and renderer=mitsuba renders the same"
        ) from error
    return bpy


@contextmanager
def _one_cpu() -> Iterator[None]:
    """Let this process see a single processor.

    Blender's thread library makes a helper thread for every other processor that it sees when
    it is loaded. They have nothing to do where one thread renders, but they wait in a busy loop:
    two workers on two processors took turns with two such threads, and were half as fast.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    everywhere = os.sched_getaffinity(0)
    # Workers that start at the same time start on different processors.
    os.sched_setaffinity(0, {sorted(everywhere)[os.getpid() % len(everywhere)]})
    try:
        yield
    finally:
        # Threads that were started meanwhile are as bound as we were.
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread), everywhere)


@contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """Send what C code prints to a file; Blender reports every image on stdout."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    sink = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        yield
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(sink)


def _configure(target: Any, settings: RendererSettings) -> None:
    """Direct light, a box filter, no randomness but the seed's; the output is raw float32."""
    target.render.engine = "CYCLES"
    cycles = target.cycles
    cycles.samples = settings.samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.sampling_pattern = "TABULATED_SOBOL"
    cycles.pixel_filter_type = "BOX"
    cycles.use_light_tree = False
    cycles.light_sampling_threshold = 0.0  # else weak light is dropped at random
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.max_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.use_auto_tile = False
    cycles.film_exposure = 1.0
    target.world = None
    target.view_settings.view_transform = "Raw"

    render = target.render
    render.threads_mode = "FIXED" if settings.threads else "AUTO"
    if settings.threads:
        render.threads = settings.threads
    render.resolution_percentage = 100
    render.use_compositing = render.use_sequencer = False
    render.use_border = render.use_crop_to_border = True
    render.use_persistent_data = True  # one BVH for all cameras of a call
    output = render.image_settings
    if hasattr(output, "media_type"):  # Blender 5 asks for it first
        output.media_type = "MULTI_LAYER_IMAGE"
        output.use_exr_interleave = True  # one part, as in Blender 4
    output.file_format = "OPEN_EXR_MULTILAYER"
    output.color_depth = "32"
    output.exr_codec = "NONE"


def _aim(target: Any, eye: Any, camera: Camera) -> None:
    k, window, render = camera.intrinsics, camera.rendered, target.render
    eye.matrix_world = blender_pose(camera.world_from_camera)
    lens = eye.data
    lens.sensor_fit = "HORIZONTAL"  # so that all is in units of the width
    lens.sensor_width = 36.0
    lens.lens = k.focal_px * 36.0 / k.width_px
    lens.clip_start, lens.clip_end = 1e-3, 1e4
    # Here pixel centres are integers, there they are at a half.
    lens.shift_x = (k.width_px / 2 - (k.cx_px + 0.5)) / k.width_px
    lens.shift_y = ((k.cy_px + 0.5) - k.height_px / 2) / k.width_px
    render.resolution_x, render.resolution_y = k.width_px, k.height_px
    # Blender cuts the product with the size down to an integer; a quarter keeps it safe
    # from rounding. Its y goes up.
    render.border_min_x = (window.left + 0.25) / k.width_px
    render.border_max_x = min((window.left + window.width + 0.25) / k.width_px, 1.0)
    render.border_min_y = (k.height_px - window.top - window.height + 0.25) / k.height_px
    render.border_max_y = min((k.height_px - window.top + 0.25) / k.height_px, 1.0)


def _image(channels: dict[str, np.ndarray], camera: Camera) -> Image:
    """Channels of the file to an image; passes that were not asked for are not there."""
    named = {name.split(".", 1)[1]: value for name, value in channels.items() if "." in name}
    radiance = np.ascontiguousarray(named["Combined.R"])
    assert radiance.shape == (camera.rendered.height, camera.rendered.width)
    depth = named.get("Depth.Z")
    label = named.get("IndexOB.X", named.get("Object Index.X"))  # of Blender 4 and 5
    if depth is None or label is None:
        return Image.without_geometry(radiance)
    depth = np.where(depth < _BACKGROUND_M, depth, np.float32(np.inf))
    normal = np.stack([named[f"Normal.{axis}"] for axis in "XYZ"], axis=-1)
    local = normal @ camera.world_from_camera[:3, :3]
    cosine = incidence(local, np.isfinite(depth), camera)
    return Image(radiance, depth, label.astype(np.uint8), cosine)


def _remove_everything(bpy: Any) -> None:
    """Remove all datablocks that we may have made; the garbage collector of Blender does not."""
    for kind in ("objects", "meshes", "materials", "lights", "cameras", "images"):
        blocks = getattr(bpy.data, kind)
        for block in list(blocks):
            blocks.remove(block, do_unlink=True)


def _read_exr(path: Path) -> dict[str, np.ndarray]:
    """Channels [h, w] float32 by full name of an EXR file as Blender writes it here.

    That is scan lines, float32, not compressed. Neither bpy nor OpenCV hands out the channels of a
    multilayer file.
    """
    data = path.read_bytes()
    attributes: dict[str, bytes] = {}
    at = 8
    while data[at]:
        name_end = data.index(0, at)
        type_end = data.index(0, name_end + 1)
        size = int.from_bytes(data[type_end + 1 : type_end + 5], "little")
        start = type_end + 5
        attributes[data[at:name_end].decode()] = data[start : start + size]
        at = start + size
    assert attributes["compression"] == b"\0"
    x0, y0, x1, y1 = np.frombuffer(attributes["dataWindow"], "<i4")
    width, height = int(x1 - x0) + 1, int(y1 - y0) + 1

    names, listing, spot = [], attributes["channels"], 0
    while listing[spot]:
        name_end = listing.index(0, spot)
        assert listing[name_end + 1 : name_end + 5] == b"\2\0\0\0", "channels are not float32"
        names.append(listing[spot:name_end].decode())
        spot = name_end + 17  # type, linearity and sampling: 16 bytes
    # A line: its number, its size, then all of channel 0, all of channel 1, ...
    line = np.dtype([("y", "<i4"), ("size", "<i4"), ("value", "<f4", (len(names), width))])
    first = at + 1 + 8 * height  # behind the table of line offsets
    lines = np.frombuffer(data, line, count=height, offset=first)
    return {name: lines["value"][:, i] for i, name in enumerate(names)}
