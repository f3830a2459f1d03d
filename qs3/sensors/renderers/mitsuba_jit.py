"""All bodies of a scene as one mesh, what a pixel sees of it, and Mitsuba's compiled kernel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body, Scene, incidence


@dataclass(frozen=True, eq=False)
class Faces:
    """All bodies as one mesh: one shape means one kernel, however many bodies there are.

    Attributes:
        mesh: all bodies.
        albedo: [F] float32.
        label: [F] uint8.
        body: [F] uint32, index of the body.
    """

    mesh: Mesh
    albedo: np.ndarray
    label: np.ndarray
    body: np.ndarray

    @staticmethod
    def of(bodies: tuple[Body, ...]) -> Faces:
        """Merged, in the order of `bodies`."""
        counts = [len(body.mesh.faces) for body in bodies]
        return Faces(
            merge([body.mesh for body in bodies]),
            np.repeat(np.array([body.albedo for body in bodies], dtype=np.float32), counts),
            np.repeat(np.array([body.label for body in bodies], dtype=np.uint8), counts),
            np.repeat(np.arange(len(bodies), dtype=np.uint32), counts),
        )

    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Three [F, 3] float64 arrays."""
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, i]] for i in range(3))
        return a, b, c

    @cached_property
    def normals(self) -> np.ndarray:
        """[F, 3] float64 unit normals, 0 for degenerate faces."""
        a, b, c = self.corners()
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)

    def seen(self, camera: Camera, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Label and cosine of incidence, [h, w], where a camera's pixels see `face` (-1: none)."""
        valid = face >= 0
        face = np.where(valid, face, 0)
        label = np.where(valid, self.label[face], 0).astype(np.uint8)
        normals = (self.normals @ camera.world_from_camera[:3, :3]).astype(np.float32)
        return label, incidence(normals[face], valid, camera)


def mitsuba_mesh(mi: Any, faces: Faces, properties: Any) -> Any:
    """The mesh in Mitsuba, filled but not yet in a scene."""
    mesh = mi.Mesh("bodies", len(faces.mesh.vertices), len(faces.mesh.faces), props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = faces.mesh.vertices.astype(np.float32).ravel()
    params["faces"] = faces.mesh.faces.astype(np.uint32).ravel()
    params.update()
    return mesh


# Offset of a shadow ray's origin along the normal, relative to 1 + the largest coordinate.
# Mitsuba's own rule for single precision, so that both paths have the same contact shadows.
_RAY_EPSILON = 1500 * 2.0**-24
TO_UNIT = 2.0**-32  # of fixed point with 32 bits


class Solid:
    """The bodies of a scene with what finds rays' hits, for any number of pictures and lights."""

    def __init__(self, mi: Any, bodies: tuple[Body, ...]) -> None:
        self.bodies, self.faces = bodies, Faces.of(bodies)
        mesh = mitsuba_mesh(mi, self.faces, mi.Properties())
        self.scene = mi.load_dict({"type": "scene", "bodies": mesh})
        self.normal = mi.Float(self.faces.normals.astype(np.float32).ravel())
        self.albedo = mi.Float(self.faces.albedo)


class JitScene:
    """A scene for the compiled variants, with our own kernel.

    Everything that may differ between two calls is an opaque variable and not a constant
    in the code, so that the kernels of the first call serve all others.
    """

    def __init__(self, mi: Any, scene: Scene, solid: Solid) -> None:
        import drjit as dr

        self._mi, self._dr, self.faces = mi, dr, solid.faces
        self._scene, self._normal, self._albedo = solid.scene, solid.normal, solid.albedo
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
        lamp = self._lamp_samples(place, seed)

        def body(index: Any, total: Any) -> tuple[Any, Any]:
            du = mi.Float(shift_u + index * step_u) * TO_UNIT - 0.5
            dv = mi.Float(shift_v + index * step_v) * TO_UNIT - 0.5
            return index + 1, total + self._shade(ray_of(u + du, v + dv), lamp(index))

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

    def _lamp_samples(self, place: Any, seed: int) -> Callable[[Any], Any]:
        """Where sample `index` of a pixel at `place` samples the area light; there is none here."""
        return lambda index: None

    def _shade(self, ray: Any, lamp: Any) -> Any:
        """Radiance along a ray, 0 where nothing is hit."""
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        valid = hit.is_valid()
        albedo = dr.gather(mi.Float, self._albedo, hit.prim_index, valid)
        light = dr.select(valid, self._ambient, 0)
        if self._projector is None:
            return albedo * light

        normal = dr.gather(mi.Normal3f, self._normal, hit.prim_index, valid)
        return albedo * (light + self._projected(ray, ray.o + hit.t * ray.d, normal, valid))

    def _projected(self, ray: Any, point: Any, normal: Any, valid: Any) -> Any:
        """Radiance that the projector gives a white matt surface at `point`."""
        mi, dr = self._mi, self._dr
        to_light = self._slide_origin - point
        x, y, z = (-dr.dot(axis, to_light) for axis in self._slide_axes)
        place = mi.Point2f(x, y) / z * self._slide_scale + 0.5
        lit = valid & (z > 0) & dr.all((place >= 0) & (place <= 1))
        slide = self._slide.eval(place, lit)[0]
        cosine = dr.dot(normal, to_light)  # times the distance
        lit &= (slide > 0) & (cosine * dr.dot(normal, -ray.d) > 0)

        start = point + normal * (self._epsilon * dr.sign(cosine))
        # strength / z^2 on a plane that faces the projector, elsewhere times the cosine of
        # incidence (cosine / distance) over that plane's (z / distance).
        light = self._strength * slide * dr.abs(cosine) / (z * z * z)
        return self._arriving(light, self._slide_origin, start, lit)

    def _arriving(
        self, light: Any, source: Any, start: Any, active: Any, coherent: bool = True
    ) -> Any:
        """What of the light from a point gets to another one: all if nothing lies between.

        `coherent`: neighbours' ways are alike; it changes the speed only.
        """
        shadow_ray = self._mi.Ray3f(start, source - start)
        shadow_ray.maxt = 1 - 1e-4
        active &= ~self._scene.ray_test(shadow_ray, coherent=coherent, active=active)
        return self._dr.select(active, light, 0)

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
