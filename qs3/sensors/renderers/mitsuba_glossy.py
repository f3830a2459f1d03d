"""What `mitsuba_jit` leaves out: surfaces that shine, and an area light with its shadows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from qs3.sensors.renderers.base import Scene
from qs3.sensors.renderers.gloss import COSINES, Gloss, kept_back
from qs3.sensors.renderers.mitsuba_jit import TO_UNIT, JitScene

_MATT = Gloss(roughness=1.0, specular=0.0)


class GlossyScene(JitScene):
    """A scene for the compiled variants with `Body.gloss` and `Scene.area`.

    Its kernel is another one, so that scenes without either keep theirs, and its bytes.
    """

    def __init__(self, mi: Any, scene: Scene) -> None:
        super().__init__(mi, scene)
        kinds = [body.gloss or _MATT for body in scene.bodies]
        self._body = mi.UInt32(self.faces.body)

        def each(values: list[float]) -> Any:
            return mi.Float(np.array(values, dtype=np.float32))

        self._square = each([kind.alpha**2 for kind in kinds])
        self._index = each([kind.refractive_index for kind in kinds])
        self._metal = each([float(kind.metal) for kind in kinds])
        tables = np.concatenate([kept_back(kind) for kind in kinds])
        self._kept_back = mi.Float(tables.astype(np.float32))
        self._area = scene.area
        if scene.area is not None:
            self._area_axes, self._area_origin = self._pose(scene.area.world_from_light)
            self._area_half = self._opaque(scene.area.side_m / 2)
            self._area_radiance = self._opaque(scene.area.radiance)

    def _lamp_samples(self, place: Any, seed: int) -> Callable[[Any], Any]:
        if self._area is None:
            return super()._lamp_samples(place, seed)
        mi, dr = self._mi, self._dr
        # Not the pixel's own shifts; a sequence of other irrational steps beside its R2.
        shift_u, shift_v = mi.sample_tea_32(place, dr.opaque(mi.UInt32, ~seed % 2**32))
        step_u, step_v = mi.UInt32(1779033703), mi.UInt32(3144134277)  # roots of 2 and 3

        def at(index: Any) -> Any:
            u, v = shift_u + index * step_u, shift_v + index * step_v
            return mi.Point2f(mi.Float(u), mi.Float(v)) * TO_UNIT

        return at

    def _shade(self, ray: Any, lamp: Any) -> Any:
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        valid = hit.is_valid()
        point = ray.o + hit.t * ray.d
        normal = dr.gather(mi.Normal3f, self._normal, hit.prim_index, valid)
        to_eye = dr.normalize(-ray.d)
        facing = normal * dr.sign(dr.dot(normal, to_eye))
        albedo = dr.gather(mi.Float, self._albedo, hit.prim_index, valid)
        times_pi = self._surface(hit.prim_index, valid, albedo, facing, to_eye)
        total = dr.select(valid, albedo * self._ambient, 0)
        if self._projector is not None:
            to_light = dr.normalize(self._slide_origin - point)
            total += times_pi(to_light) * self._projected(ray, point, normal, valid)
        if self._area is not None:
            total += self._from_area(point, facing, valid, lamp, times_pi)
        return total

    def _surface(
        self, face: Any, valid: Any, albedo: Any, normal: Any, to_eye: Any
    ) -> Callable[[Any], Any]:
        """Pi f of the surface, by the unit vector to the light; see `gloss.times_pi`."""
        mi, dr = self._mi, self._dr
        body = dr.gather(mi.UInt32, self._body, face, valid)
        square, index, metal = (
            dr.gather(mi.Float, values, body, valid)
            for values in (self._square, self._index, self._metal)
        )
        cos_o = self._clip(dr.dot(normal, to_eye), 1e-6, 1)
        place = cos_o * (COSINES - 1)
        low = mi.UInt32(self._clip(place, 0, COSINES - 2))
        left, right = (
            dr.gather(mi.Float, self._kept_back, body * COSINES + low + i, valid) for i in (0, 1)
        )
        kept = dr.lerp(left, right, place - mi.Float(low))
        diffuse = dr.select(metal > 0, 0, albedo * (1 - kept))

        def times_pi(to_light: Any) -> Any:
            cos_i = self._clip(dr.dot(normal, to_light), 1e-6, 1)
            half = dr.normalize(to_light + to_eye)
            across = dr.dot(normal, half)
            facets = square / dr.square(dr.square(across) * (square - 1) + 1)
            seen = 0.5 / (
                cos_i * dr.sqrt(square + (1 - square) * dr.square(cos_o))
                + cos_o * dr.sqrt(square + (1 - square) * dr.square(cos_i))
            )
            met = self._clip(dr.dot(to_eye, half), 0, 1)
            g = dr.sqrt(dr.square(index) - 1 + dr.square(met))
            other = (met * (g + met) - 1) / (met * (g - met) + 1)
            dielectric = 0.5 * dr.square((g - met) / (g + met)) * (1 + dr.square(other))
            reflected = dr.select(metal > 0, albedo + (1 - albedo) * (1 - met) ** 5, dielectric)
            return diffuse + facets * seen * reflected

        return times_pi

    def _from_area(
        self, point: Any, facing: Any, valid: Any, lamp: Any, times_pi: Callable[[Any], Any]
    ) -> Any:
        """Radiance by a place on the area light, drawn evenly over the solid angle it fills.

        After Urena, Fajardo and King, "An Area-Preserving Parametrization for Spherical
        Rectangles", EGSR 2013.
        """
        mi, dr = self._mi, self._dr
        start = point + facing * self._epsilon
        seen_from = start - self._area_origin
        x, y, z = (dr.dot(axis, seen_from) for axis in self._area_axes)
        before = valid & (z > 0)
        z = dr.select(before, -z, -1)  # of the light's plane, from the point
        x0, x1 = -self._area_half - x, self._area_half - x
        y0, y1 = -self._area_half - y, self._area_half - y
        # z of the normals of the planes through the point and each side
        sides = [a * dr.rsqrt(a * a + z * z) for a in (-y0, x1, y1, -x0)]
        corners = [dr.acos(self._clip(-sides[i] * sides[(i + 1) % 4], -1, 1)) for i in range(4)]
        rest = 2 * dr.pi - corners[2] - corners[3]
        solid_angle = self._clip(corners[0] + corners[1] - rest, 0, 2 * dr.pi)

        angle = lamp.x * solid_angle + rest
        sine = dr.sin(angle)
        slope = (dr.cos(angle) * sides[0] - sides[2]) / dr.select(sine == 0, 1e-9, sine)
        cosine = dr.rsqrt(slope * slope + sides[0] * sides[0] + 1e-12)
        cosine = self._clip(dr.copysign(cosine, slope), -1, 1)
        u = -cosine * z * dr.rsqrt(self._clip(1 - cosine * cosine, 1e-12, 1))
        u = self._clip(u, x0, x1)
        distance = dr.sqrt(u * u + z * z)
        low = y0 * dr.rsqrt(distance * distance + y0 * y0)
        high = y1 * dr.rsqrt(distance * distance + y1 * y1)
        level = dr.lerp(low, high, lamp.y)
        v = level * distance * dr.rsqrt(self._clip(1 - level * level, 1e-7, 1))
        v = self._clip(v, y0, y1)

        ax, ay, az = self._area_axes
        there = ax * u + ay * v + az * z
        to_light = dr.normalize(there)
        cos_i = dr.dot(facing, to_light)
        lit = before & (cos_i > 0)
        lit &= self._free(start, mi.Point3f(start + there), lit)
        arriving = self._area_radiance * cos_i * solid_angle / dr.pi
        return dr.select(lit, arriving * times_pi(to_light), 0)

    def _clip(self, value: Any, low: Any, high: Any) -> Any:
        """As dr.clip, whose minimum and maximum some versions of LLVM cannot compile."""
        select = self._dr.select
        return select(value < low, low, select(value > high, high, value))
