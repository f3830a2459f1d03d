"""Blender's Cycles, on the CPU or a GPU: the renderer of the paper, our reference.

The only place that imports bpy. One process holds one Blender with global state; every call
builds its own data, renders, and removes it, so nothing is left for the next call.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera
from qs3.sensors.renderers import blender_devices
from qs3.sensors.renderers.base import (
    Body,
    Image,
    Projector,
    RendererSettings,
    Scene,
    give_memory_back,
    incidence,
)
from qs3.sensors.renderers.exr import read_exr

# Cycles: a point light of P watts lights a white plane at 1 m to the radiance P / (4 pi^2).
_WATT_PER_RADIANCE = 4 * math.pi**2
# How far behind a surface its shadow caster lies, relative to the distance from the projector:
# 0.2 mm at 2 m, about the gap that Mitsuba leaves.
_SHADOW_GAP = 1e-4
_BACKGROUND_M = 1e9  # Cycles writes 1e10 m where nothing is hit
_PACKAGES = "libxi6 libxxf86vm1 libxfixes3 libxrender1 libxkbcommon0 libsm6 libgl1 libegl1"


class BlenderRenderer:
    """A `Renderer` on Blender's Cycles.

    Attributes:
        settings: samples a pixel and threads.
        device: on what it renders.
    """

    def __init__(
        self, samples: int = 16, threads: int = 1, device: str = "auto", name: str = "blender"
    ) -> None:
        """Start Blender inside this process.

        Args:
            samples: samples a pixel.
            threads: 0 is all cores.
            device: "auto" (a GPU if Blender lists one for OptiX or CUDA, else the CPU), "cpu"
                or "gpu". The two make different bytes, so a dataset's recipe says which it was.
            name: what the configuration calls it; taken so that its node can be instantiated.

        Raises:
            RenderError: Blender is not installed, a library that it needs is missing, or a GPU
                is wanted and none is there.
        """
        self.settings = RendererSettings(samples, threads)
        with _one_cpu() if threads == 1 else nullcontext():
            self._bpy = _import_bpy()
        listed = {} if device == "cpu" else blender_devices.list_gpus(self._bpy)
        self.device = blender_devices.choose(device, listed)

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render every camera; see `Renderer.render`."""
        if len(geometry) != len(cameras):
            raise RenderError(f"{len(cameras)} cameras but {len(geometry)} geometry flags")
        with tempfile.TemporaryDirectory(prefix="qs3-blender-") as folder:
            said = Path(folder) / "blender.log"
            try:
                with _quiet(said):
                    return self._render(scene, cameras, seed, geometry, Path(folder))
            except (RuntimeError, OSError) as error:
                tail = said.read_text(errors="replace")[-500:].strip() if said.exists() else ""
                raise RenderError(f"Blender failed: {error} {tail}".strip()) from error

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions; see `Renderer.provenance`."""
        found = {
            "renderer": "blender",
            "variant": self.device.variant,
            "bpy": self._bpy.app.version_string,
            "samples": str(self.settings.samples),
        }
        if self.device.name:
            found["device"] = self.device.name
        return found

    def _render(
        self, scene: Scene, cameras: list[Camera], seed: int, geometry: list[bool], folder: Path
    ) -> list[Image]:
        """`render` without the handling of errors and noise."""
        bpy = self._bpy
        # Takes some 20 ms, and undoes what other code of this process did to the global state.
        bpy.ops.wm.read_factory_settings(use_empty=True)
        target = bpy.context.scene
        _configure(target, self.settings)
        blender_devices.use(bpy, target.cycles, self.device)
        images = []
        try:
            bodies = [_add_body(bpy, target, body, scene.ambient) for body in scene.bodies]
            if scene.projector is not None:
                _add_projector(bpy, target, scene.projector)
                for thing in bodies:
                    _cast_shadow_by_copy(target, thing, scene.projector)
            eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
            target.collection.objects.link(eye)
            target.camera = eye
            layer = target.view_layers[0]
            for index, (camera, wanted) in enumerate(zip(cameras, geometry, strict=True)):
                _aim(target, eye, camera)
                layer.use_pass_z = layer.use_pass_object_index = layer.use_pass_normal = wanted
                # Cameras of one call must not share their sampling noise.
                target.cycles.seed = (seed + 0x9E3779B9 * index) % 2**31
                path = folder / f"{index}.exr"
                target.render.filepath = str(path)
                bpy.ops.render.render(write_still=True)
                images.append(_image(read_exr(path), camera))
                path.unlink()
        finally:
            target.render.use_persistent_data = False
            _remove_everything(bpy)
            give_memory_back()
        return images


def _import_bpy() -> Any:
    try:
        import bpy
    except ImportError as error:
        if error.name == "bpy":
            raise RenderError(
                "Blender is not installed: pip install 'bpy>=4.5,<4.6' (Python 3.11)"
            ) from None
        raise RenderError(
            f"Blender cannot be loaded: {error}. On Debian, apt install {_PACKAGES}"
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
def _quiet(said: Path) -> Iterator[None]:
    """Send what C code prints to a file; Blender reports every image on stdout."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    sink = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
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
    output.file_format = "OPEN_EXR_MULTILAYER"
    output.color_depth = "32"
    output.exr_codec = "NONE"


def _add_body(bpy: Any, target: Any, body: Body, ambient: float) -> Any:
    """The Blender object of a body."""
    faces = body.mesh.faces
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]  # Blender's meshes may not repeat a corner
    mesh = bpy.data.meshes.new("body")
    mesh.vertices.add(len(body.mesh.vertices))
    mesh.vertices.foreach_set("co", body.mesh.vertices.astype(np.float32).ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_flat()

    material = bpy.data.materials.new("diffuse")
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"  # the ambient term lights nothing else
    tree = material.node_tree
    tree.nodes.clear()
    node, link = tree.nodes.new, tree.links.new
    diffuse, glow = node("ShaderNodeBsdfDiffuse"), node("ShaderNodeEmission")
    diffuse.inputs["Color"].default_value = (body.albedo, body.albedo, body.albedo, 1.0)
    diffuse.inputs["Roughness"].default_value = 0.0
    glow.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    glow.inputs["Strength"].default_value = body.albedo * ambient
    total, output = node("ShaderNodeAddShader"), node("ShaderNodeOutputMaterial")
    link(diffuse.outputs[0], total.inputs[0])
    link(glow.outputs[0], total.inputs[1])
    link(total.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)

    thing = bpy.data.objects.new("body", mesh)
    thing.pass_index = body.label
    thing.visible_diffuse = False  # Cycles follows a diffuse ray to what glows even at 0 bounces
    target.collection.objects.link(thing)
    return thing


def _cast_shadow_by_copy(target: Any, thing: Any, projector: Projector) -> None:
    """Let an invisible copy cast the shadow, enlarged a little about the projector.

    CAD files often hold a face twice. Cycles starts a shadow ray on the surface itself, so
    the twins would shadow each other in half of all pixels. The copy lies just behind the
    surface as the projector sees it, and has the same outline from there.
    """
    centre, scale = np.asarray(projector.world_from_projector)[:3, 3], 1 + _SHADOW_GAP
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = centre * (1 - scale)
    copy = thing.copy()
    copy.matrix_world = _matrix(matrix)
    copy.visible_camera = False
    thing.visible_shadow = False
    target.collection.objects.link(copy)


def _add_projector(bpy: Any, target: Any, projector: Projector) -> None:
    height, width = projector.slide.shape
    tan_x = projector.tan_half_width
    tan_y = tan_x * height / width

    picture = bpy.data.images.new("slide", width, height, float_buffer=True, is_data=True)
    picture.use_half_precision = False
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = projector.slide[::-1, :, None]  # Blender's first row is the lowest
    picture.pixels.foreach_set(pixels.ravel())
    picture.update()

    light = bpy.data.lights.new("projector", "SPOT")
    light.energy = projector.strength * _WATT_PER_RADIANCE
    light.shadow_soft_size = 0.0  # a point: hard shadows
    light.spot_blend = 0.0
    # The cone only has to hold the slide; the slide's edge is the texture's.
    light.spot_size = min(2 * math.atan(math.hypot(tan_x, tan_y)) + 0.1, math.radians(179.0))
    light.use_nodes = True
    tree = light.node_tree
    tree.nodes.clear()
    node, link = tree.nodes.new, tree.links.new

    # The direction (x, y, z) in the light's frame (it looks along -z, y up) falls on the
    # slide at (x, y) / -z.
    coordinates, parts = node("ShaderNodeTexCoord"), node("ShaderNodeSeparateXYZ")
    divide, place = node("ShaderNodeVectorMath"), node("ShaderNodeVectorMath")
    divide.operation, place.operation = "DIVIDE", "MULTIPLY_ADD"
    place.inputs[1].default_value = (-0.5 / tan_x, -0.5 / tan_y, 0.0)
    place.inputs[2].default_value = (0.5, 0.5, 0.0)
    texture = node("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = picture, "Linear", "CLIP"
    link(coordinates.outputs["Normal"], parts.inputs[0])
    link(coordinates.outputs["Normal"], divide.inputs[0])
    link(parts.outputs["Z"], divide.inputs[1])
    link(divide.outputs[0], place.inputs[0])
    link(place.outputs[0], texture.inputs["Vector"])

    # A point's light falls on a plane as cos^3 of the angle to the axis; a projector's lens
    # is built so that the plane is evenly bright.
    cosine, rise = node("ShaderNodeMath"), node("ShaderNodeMath")
    cosine.operation, rise.operation = "ABSOLUTE", "POWER"
    rise.inputs[1].default_value = -3.0
    emission, output = node("ShaderNodeEmission"), node("ShaderNodeOutputLight")
    link(parts.outputs["Z"], cosine.inputs[0])
    link(cosine.outputs[0], rise.inputs[0])
    link(texture.outputs["Color"], emission.inputs["Color"])
    link(rise.outputs[0], emission.inputs["Strength"])
    link(emission.outputs[0], output.inputs["Surface"])

    thing = bpy.data.objects.new("projector", light)
    thing.matrix_world = _blender_pose(projector.world_from_projector)
    target.collection.objects.link(thing)


def _aim(target: Any, eye: Any, camera: Camera) -> None:
    """Pose, lens and window of the camera."""
    k, window, render = camera.intrinsics, camera.rendered, target.render
    eye.matrix_world = _blender_pose(camera.world_from_camera)
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


def _blender_pose(world_from_local: np.ndarray) -> Any:
    """Pose of a camera or light: they look along -z with y up."""
    return _matrix(np.asarray(world_from_local) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def _matrix(matrix: np.ndarray) -> Any:
    import mathutils

    return mathutils.Matrix(matrix.tolist())


def _image(channels: dict[str, np.ndarray], camera: Camera) -> Image:
    """Channels of the file to an image; passes that were not asked for are not there."""
    named = {name.split(".", 1)[1]: value for name, value in channels.items() if "." in name}
    radiance = np.ascontiguousarray(named["Combined.R"])
    shape = (camera.rendered.height, camera.rendered.width)
    if radiance.shape != shape:
        raise RenderError(f"Blender rendered {radiance.shape} pixels instead of {shape}")
    depth, label = named.get("Depth.Z"), named.get("IndexOB.X")
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
