"""Mitsuba 3: the fast renderer, on the CPU (LLVM, scalar) or an NVIDIA GPU (CUDA).

With a compiled ("JIT") variant the whole measurement (ray, hit, slide, shadow ray, sum over
samples) is one kernel of ours, traced once and then used for every scene, window and number
of samples. Mitsuba's own integrators would be compiled again for each window size, which
costs more than the render. The scalar variant cannot trace kernels, so there Mitsuba's
`direct` integrator and its `projector` emitter do the same; a test holds the two together.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers import llvm
from qs3.sensors.renderers.base import Body, Image, Projector, RendererSettings, Scene

# Offset of a shadow ray's origin along the normal, relative to 1 + the largest coordinate.
# Mitsuba's own rule for single precision, so that both paths have the same contact shadows.
_RAY_EPSILON = 1500 * 2.0**-24


class MitsubaRenderer:
    """A `Renderer` on Mitsuba 3.

    Attributes:
        settings: samples a pixel and threads.
        variant: the Mitsuba variant in use.
    """

    def __init__(
        self,
        samples: int = 16,
        threads: int = 1,
        variant: str = "auto",
        name: str = "mitsuba",
    ) -> None:
        """Find a variant that works here and load it.

        Args:
            samples: samples a pixel.
            threads: 0 is all cores.
            variant: "auto", or a Mitsuba variant ("llvm_ad_mono", "cuda_ad_mono", "scalar_rgb").
            name: what the configuration calls it; taken so that its node can be instantiated.

        Raises:
            RenderError: Mitsuba is not installed, or the variant cannot run here.
        """
        self.settings = RendererSettings(samples, threads)
        try:
            known = _import_mitsuba().variants()
        except ImportError as error:
            raise RenderError(
                f"Mitsuba cannot be imported ({error}): pip install mitsuba"
            ) from None
        if variant != "auto" and variant not in known:
            raise RenderError(
                f"renderer.variant={variant} is unknown; there are {', '.join(known)}"
            )
        self._probe = llvm.find_variant(variant)
        self.variant = self._probe.variant
        self._activate()

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render every camera; see `Renderer.render`."""
        if len(geometry) != len(cameras):
            raise RenderError(f"{len(cameras)} cameras but {len(geometry)} geometry flags")
        mi = self._activate()
        try:
            make = _ScalarScene if self.variant.startswith("scalar_") else _JitScene
            built = make(mi, scene)
            images = []
            for index, (camera, wanted) in enumerate(zip(cameras, geometry, strict=True)):
                # Cameras of one call must not share their sampling noise.
                camera_seed = (seed + 0x9E3779B9 * index) % 2**32
                radiance = built.radiance(camera, self.settings.samples, camera_seed)
                if wanted:
                    depth_m, face = built.geometry(camera)
                    images.append(Image(radiance, depth_m, *built.faces.seen(camera, face)))
                else:
                    images.append(Image.without_geometry(radiance))
        except RuntimeError as error:
            raise RenderError(f"Mitsuba ({self.variant}) failed: {error}") from error
        return images

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions; see `Renderer.provenance`."""
        found = {
            "renderer": "mitsuba",
            "variant": self.variant,
            "mitsuba": version("mitsuba"),
            "drjit": version("drjit"),
            "samples": str(self.settings.samples),
        }
        if self._probe.llvm_path is not None:
            number = ".".join(map(str, llvm.libllvm_version(self._probe.llvm_path)))
            found["llvm"] = number or os.path.basename(self._probe.llvm_path)
        return found

    def _activate(self) -> Any:
        """Mitsuba with our variant and threads, whatever else in this process used it since."""
        if self._probe.llvm_path is not None:
            os.environ.setdefault(llvm.LIBRARY_VARIABLE, self._probe.llvm_path)
        mi = _import_mitsuba()
        import drjit as dr

        try:
            if mi.variant() != self.variant:
                mi.set_variant(self.variant)
        except (ImportError, RuntimeError) as error:
            raise RenderError(
                f"Mitsuba variant {self.variant} cannot be loaded: {error}"
            ) from error
        threads = self.settings.threads or os.cpu_count() or 1
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
        return mi


def render_probe_scene(variant: str) -> None:
    """Render a small scene that uses every kernel; run in a child process by `llvm`."""
    # The probe itself must not probe: hand it the answer that it is about to verify.
    path = os.environ.get(llvm.LIBRARY_VARIABLE) if variant.startswith("llvm_") else None
    renderer = object.__new__(MitsubaRenderer)
    renderer.settings = RendererSettings(samples=2)
    renderer.variant = variant
    renderer._probe = llvm.Probe(variant, path)
    vertices = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], dtype=np.float64)
    body = Body(Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])))
    projector = Projector(np.eye(4), np.ones((8, 8), dtype=np.float32), tan_half_width=1.0)
    camera = Camera(Intrinsics.centred(8, 8, 16.0), np.eye(4))
    (image,) = renderer.render(
        Scene((body,), projector, ambient=0.5), [camera], seed=0, geometry=[True]
    )
    expected = body.albedo * (0.5 + 1 / 4)
    if not np.allclose(image.radiance, expected, rtol=1e-3) or not np.allclose(image.depth_m, 2):
        raise RenderError(f"variant {variant} renders wrong values")


def _import_mitsuba() -> Any:
    import mitsuba

    return mitsuba


@dataclass(frozen=True, eq=False)
class _Faces:
    """All bodies as one mesh: one shape means one kernel, however many bodies there are.

    Attributes:
        mesh: all bodies.
        albedo: [F] float32.
        label: [F] uint8.
    """

    mesh: Mesh
    albedo: np.ndarray
    label: np.ndarray

    @staticmethod
    def of(bodies: tuple[Body, ...]) -> _Faces:
        counts = [len(body.mesh.faces) for body in bodies]
        return _Faces(
            merge([body.mesh for body in bodies]),
            np.repeat(np.array([body.albedo for body in bodies], dtype=np.float32), counts),
            np.repeat(np.array([body.label for body in bodies], dtype=np.uint8), counts),
        )

    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Three [F, 3] float64 arrays."""
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, i]] for i in range(3))
        return a, b, c

    def normals(self) -> np.ndarray:
        """[F, 3] float64 unit normals, 0 for degenerate faces."""
        a, b, c = self.corners()
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)

    def seen(self, camera: Camera, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Label and cosine of incidence, [h, w], where a camera's pixels see `face` (-1: none)."""
        valid, window, k = face >= 0, camera.rendered, camera.intrinsics
        face = np.where(valid, face, 0)
        label = np.where(valid, self.label[face], 0).astype(np.uint8)
        x = (window.left + np.arange(window.width) - k.cx_px) / k.focal_px
        y = (window.top + np.arange(window.height) - k.cy_px)[:, None] / k.focal_px
        normals = (self.normals() @ camera.world_from_camera[:3, :3]).astype(np.float32)
        nx, ny, nz = np.moveaxis(normals[face], -1, 0)
        cosine = np.abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1)
        return label, np.where(valid, np.minimum(cosine, 1), 0).astype(np.float32)


def _mi_mesh(mi: Any, faces: _Faces, properties: Any) -> Any:
    """The mesh in Mitsuba, filled but not yet in a scene."""
    mesh = mi.Mesh("bodies", len(faces.mesh.vertices), len(faces.mesh.faces), props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = faces.mesh.vertices.astype(np.float32).ravel()
    params["faces"] = faces.mesh.faces.astype(np.uint32).ravel()
    params.update()
    return mesh


class _JitScene:
    """A scene for the compiled variants, with our own kernel.

    Everything that may differ between two calls is an opaque variable and not a constant
    in the code, so that the kernels of the first call serve all others.
    """

    def __init__(self, mi: Any, scene: Scene) -> None:
        import drjit as dr

        self._mi, self._dr = mi, dr
        self.faces = _Faces.of(scene.bodies)
        mesh = _mi_mesh(mi, self.faces, mi.Properties())
        self._scene = mi.load_dict({"type": "scene", "bodies": mesh})
        self._normal = mi.Float(self.faces.normals().astype(np.float32).ravel())
        self._albedo = mi.Float(self.faces.albedo)
        self._ambient = self._opaque(scene.ambient)
        self._epsilon = self._opaque(
            _RAY_EPSILON * (1 + float(np.abs(self.faces.mesh.vertices).max()))
        )
        self._projector = scene.projector
        if scene.projector is not None:
            slide = scene.projector.slide
            self._slide = mi.Texture2f(
                mi.TensorXf(np.ascontiguousarray(slide[..., None])),
                wrap_mode=dr.WrapMode.Clamp,
                filter_mode=dr.FilterMode.Linear,
            )
            self._slide_axes, self._slide_origin = self._pose(scene.projector.world_from_projector)
            tan_x = scene.projector.tan_half_width
            self._slide_scale = mi.Vector2f(
                self._opaque(0.5 / tan_x),
                self._opaque(0.5 / (tan_x * slide.shape[0] / slide.shape[1])),
            )
            self._strength = self._opaque(scene.projector.strength)

    def radiance(self, camera: Camera, samples: int, seed: int) -> np.ndarray:
        """[h, w] float32: mean over the samples of a pixel."""
        mi, dr = self._mi, self._dr
        u, v, ray_of = self._pixels(camera)
        # Where a pixel samples depends on the seed and its place in the whole image, not on
        # the window or the threads: an R2 sequence, shifted at random in every pixel.
        place = mi.UInt32(u) + mi.UInt32(v) * dr.opaque(mi.UInt32, camera.intrinsics.width_px)
        shift_u, shift_v = mi.sample_tea_32(place, dr.opaque(mi.UInt32, seed))
        # The golden ratio's counterpart for two dimensions, in 32 bit fixed point.
        step_u, step_v = mi.UInt32(3242174889), mi.UInt32(2447445414)
        to_unit = 2.0**-32

        def body(index: Any, total: Any) -> tuple[Any, Any]:
            du = mi.Float(shift_u + index * step_u) * to_unit - 0.5
            dv = mi.Float(shift_v + index * step_v) * to_unit - 0.5
            return index + 1, total + self._shade(ray_of(u + du, v + dv))

        count = dr.opaque(mi.UInt32, samples)
        _, total = dr.while_loop(
            state=(dr.zeros(mi.UInt32, dr.width(u)), dr.zeros(mi.Float, dr.width(u))),
            cond=lambda index, total: index < count,
            body=body,
            labels=("index", "total"),
        )
        window = camera.rendered
        mean = total / mi.Float(count)
        return np.array(mean, dtype=np.float32).reshape(window.height, window.width)

    def geometry(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depth, and index of the face (-1: none), [h, w], at the pixels' centres."""
        u, v, ray_of = self._pixels(camera)
        hit = self._scene.ray_intersect_preliminary(ray_of(u, v), coherent=True)
        self._dr.eval(hit.t, hit.prim_index)
        window = camera.rendered
        # The direction of a ray has length 1 along the optical axis, so t is the depth.
        depth = np.array(hit.t, dtype=np.float32).reshape(window.height, window.width)
        face = np.array(hit.prim_index).reshape(depth.shape)
        return depth, np.where(np.isfinite(depth), face.astype(np.int64), -1)

    def _shade(self, ray: Any) -> Any:
        """Radiance along a ray, 0 where nothing is hit."""
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        valid = hit.is_valid()
        albedo = dr.gather(mi.Float, self._albedo, hit.prim_index, valid)
        light = dr.select(valid, self._ambient, 0)
        if self._projector is None:
            return albedo * light

        normal = dr.gather(mi.Normal3f, self._normal, hit.prim_index, valid)
        point = ray.o + hit.t * ray.d
        to_light = self._slide_origin - point
        x, y, z = (-dr.dot(axis, to_light) for axis in self._slide_axes)
        place = mi.Point2f(x, y) / z * self._slide_scale + 0.5
        lit = valid & (z > 0) & dr.all((place >= 0) & (place <= 1))
        slide = self._slide.eval(place, lit)[0]
        cosine = dr.dot(normal, to_light)  # times the distance
        lit &= (slide > 0) & (cosine * dr.dot(normal, -ray.d) > 0)

        start = point + normal * (self._epsilon * dr.sign(cosine))
        shadow_ray = mi.Ray3f(start, self._slide_origin - start)
        shadow_ray.maxt = 1 - 1e-4
        lit &= ~self._scene.ray_test(shadow_ray, coherent=True, active=lit)
        # strength / z^2 on a plane that faces the projector, elsewhere times the cosine of
        # incidence (cosine / distance) over that plane's (z / distance).
        return albedo * (
            light + dr.select(lit, self._strength * slide * dr.abs(cosine) / (z * z * z), 0)
        )

    def _pixels(self, camera: Camera) -> tuple[Any, Any, Callable[[Any, Any], Any]]:
        """Pixel centres (u, v) of the window, row by row, and the ray through a place (u, v)."""
        mi, dr = self._mi, self._dr
        window, k = camera.rendered, camera.intrinsics
        index = dr.arange(mi.UInt32, window.width * window.height)
        width = dr.opaque(mi.UInt32, window.width)
        row = index // width
        u = mi.Float(index - row * width + dr.opaque(mi.UInt32, window.left))
        v = mi.Float(row + dr.opaque(mi.UInt32, window.top))
        axes, origin = self._pose(camera.world_from_camera)
        cx, cy, per_focal = map(self._opaque, (k.cx_px, k.cy_px, 1 / k.focal_px))

        def ray_of(u: Any, v: Any) -> Any:
            x, y = (u - cx) * per_focal, (v - cy) * per_focal
            return mi.Ray3f(origin, mi.Vector3f(axes[0] * x + axes[1] * y + axes[2]))

        return u, v, ray_of

    def _pose(self, world_from_local: np.ndarray) -> tuple[list[Any], Any]:
        """The three axes and the origin of a frame, in the world."""
        mi = self._mi
        columns = np.asarray(world_from_local, dtype=np.float64)[:3].T
        axes = [mi.Vector3f(*map(self._opaque, column)) for column in columns[:3]]
        return axes, mi.Point3f(*map(self._opaque, columns[3]))

    def _opaque(self, value: float) -> Any:
        return self._dr.opaque(self._mi.Float, float(value))


class _ScalarScene:
    """A scene for the scalar variants, with Mitsuba's own integrators and emitter."""

    def __init__(self, mi: Any, scene: Scene) -> None:
        self._mi = mi
        self.faces = _Faces.of(scene.bodies)
        self._ambient = scene.ambient
        properties = mi.Properties()
        reflectance = {"type": "mesh_attribute", "name": "face_albedo"}
        diffuse = {"type": "diffuse", "reflectance": reflectance}
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse})
        mesh = _mi_mesh(mi, self.faces, properties)
        mesh.add_attribute("face_albedo", 3, np.repeat(self.faces.albedo, 3))
        self._has_projector = scene.projector is not None
        parts = {"type": "scene", "bodies": mesh}
        if scene.projector is not None:
            parts["projector"] = self._emitter(scene.projector)
        self._scene = mi.load_dict(parts)

    def radiance(self, camera: Camera, samples: int, seed: int) -> np.ndarray:
        """[h, w] float32: mean over the samples of a pixel."""
        window = camera.rendered
        total = np.zeros((window.height, window.width), dtype=np.float32)
        sampler = {"type": "multijitter", "sample_count": samples}
        # Two passes are faster than one with a nested integrator (measured: 1.5x).
        if self._has_projector:
            direct = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
            total += self._run(camera, direct, sampler, seed)[..., 0]
        if self._ambient > 0:
            albedo = {"type": "aov", "aovs": "a:albedo"}
            total += np.float32(self._ambient) * self._run(camera, albedo, sampler, seed)[..., -3]
        return total

    def geometry(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depth, and index of the face (-1: none), [h, w], at the pixels' centres."""
        # One sample without jitter is at the centre.
        sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
        aovs = {"type": "aov", "aovs": "f:prim_index,t:depth"}
        found = self._run(camera, aovs, sampler, seed=0)[..., -2:]
        face, valid = found[..., 0].astype(np.int64), found[..., 1] > 0
        depth = np.full(valid.shape, np.inf, dtype=np.float32)
        depth[valid] = self._plane_depth(camera, face)[valid]
        return depth, np.where(valid, face, -1)

    def _plane_depth(self, camera: Camera, face: np.ndarray) -> np.ndarray:
        """[h, w] depth of the face's plane along the ray through a pixel's centre.

        Mitsuba's own depth carries the rounding of its crop matrix, so that a window would
        differ from the whole image in the last bit.
        """
        window, k = camera.rendered, camera.intrinsics
        x = (window.left + np.arange(window.width) - k.cx_px) / k.focal_px
        y = (window.top + np.arange(window.height) - k.cy_px) / k.focal_px
        rotation, origin = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
        normal = (self.faces.normals() @ rotation)[face]  # [h, w, 3], camera axes
        corners = np.stack([(corner - origin) @ rotation for corner in self.faces.corners()])
        depths = corners[:, :, 2]
        along = normal[..., 0] * x + normal[..., 1] * y[:, None] + normal[..., 2]
        plane = np.einsum("hwc,hwc->hw", normal, corners[0][face])
        safe = np.where(np.abs(along) > 0, along, 1)
        # A face seen edge-on has no well-defined depth; it stays within its corners'.
        return np.clip(plane / safe, depths.min(axis=0)[face], depths.max(axis=0)[face])

    def _run(self, camera: Camera, integrator: dict, sampler: dict, seed: int) -> np.ndarray:
        """[h, w, channels] float32."""
        mi = self._mi
        window, k = camera.rendered, camera.intrinsics
        # Mitsuba's camera has x to the left and y up.
        pose = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
        film = {
            "type": "hdrfilm",
            "width": k.width_px,
            "height": k.height_px,
            "crop_offset_x": window.left,
            "crop_offset_y": window.top,
            "crop_width": window.width,
            "crop_height": window.height,
            "rfilter": {"type": "box"},  # others make the sums depend on the threads
            "component_format": "float32",
            "pixel_format": "luminance",
        }
        sensor = {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(pose),
            "fov": 2 * math.degrees(math.atan(k.width_px / (2 * k.focal_px))),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e4,
            # Here pixel centres are integers, there they are at a half.
            "principal_point_offset_x": 0.5 - (k.cx_px + 0.5) / k.width_px,
            "principal_point_offset_y": 0.5 - (k.cy_px + 0.5) / k.height_px,
            "film": film,
            "sampler": sampler,
        }
        # By default the size of a block, and with it the seeds, depends on the threads.
        image = mi.render(
            self._scene,
            sensor=mi.load_dict(sensor),
            integrator=mi.load_dict({**integrator, "block_size": 32}),
            spp=sampler["sample_count"],
            seed=seed,
        )
        return np.array(image, dtype=np.float32)

    def _emitter(self, projector: Projector) -> dict:
        mi = self._mi
        pose = np.asarray(projector.world_from_projector) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        return {
            "type": "projector",
            "to_world": mi.ScalarTransform4f(pose),
            "fov": 2 * math.degrees(math.atan(projector.tan_half_width)),
            "fov_axis": "x",
            "scale": projector.strength,
            "irradiance": {
                "type": "bitmap",
                "bitmap": mi.Bitmap(np.ascontiguousarray(projector.slide[..., None])),
                "raw": True,
                "filter_type": "bilinear",
                "wrap_mode": "clamp",
            },
        }
