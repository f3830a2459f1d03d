"""The reflecting facets of `gloss`, for Mitsuba's compiled variants."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.sensors.renderers.base import Scene
from qs3.sensors.renderers.gloss import COSINES, Gloss, kept_back
from qs3.sensors.renderers.mitsuba_jit import TO_UNIT, JitScene, Solid


@dataclass
class Facets:
    """Facets of the surfaces that a bundle of rays meets, by unit vectors.

    Attributes:
        mi, dr: the modules.
        normal: on the eye's side.
        square: alpha^2; the rest as in `gloss`.
        cos_o: cosine of the angle to the eye.
    """

    mi: Any
    dr: Any
    normal: Any
    to_eye: Any
    square: Any
    refractive_index: Any

    def __post_init__(self) -> None:
        self.cos_o = clip(self.dr, self.dr.dot(self.normal, self.to_eye), 1e-6, 1)

    def times_pi(self, to_light: Any) -> Any:
        """Pi f of the facets alone."""
        dr, square = self.dr, self.square
        cos_i = clip(dr, dr.dot(self.normal, to_light), 1e-6, 1)
        half = dr.normalize(to_light + self.to_eye)
        seen = 0.5 / (
            cos_i * dr.sqrt(square + (1 - square) * dr.square(self.cos_o))
            + self.cos_o * dr.sqrt(square + (1 - square) * dr.square(cos_i))
        )
        met = clip(dr, dr.dot(self.to_eye, half), 0, 1)
        g = dr.sqrt(dr.square(self.refractive_index) - 1 + dr.square(met))
        other = (met * (g + met) - 1) / (met * (g - met) + 1)
        fresnel = 0.5 * dr.square((g - met) / (g + met)) * (1 + dr.square(other))
        return self._spread(half) * seen * fresnel

    def density(self, to_light: Any) -> Any:
        """Density of `reflected` over the solid angle (Heitz, JCGT 2018, eq. 17)."""
        dr, square = self.dr, self.square
        half = dr.normalize(to_light + self.to_eye)
        masking = self.cos_o + dr.sqrt(square + (1 - square) * dr.square(self.cos_o))
        return self._spread(half) / (2 * dr.pi * masking)

    def reflected(self, s: Any, t: Any) -> Any:
        """Where a facet sends the ray from the eye; one of those that the eye sees, as Heitz draws.

        `s` and `t` are drawn from 0..1.
        """
        mi, dr = self.mi, self.dr
        alpha, frame = dr.sqrt(self.square), mi.Frame3f(self.normal)
        eye = frame.to_local(self.to_eye)
        # Stretched to facets of slope 1.
        seen = dr.normalize(mi.Vector3f(alpha * eye.x, alpha * eye.y, eye.z))
        across = dr.square(seen.x) + dr.square(seen.y)
        level = dr.select(across > 1e-12, dr.rsqrt(across + 1e-30), 0)
        first = mi.Vector3f(-seen.y * level, seen.x * level, 0)
        first = dr.select(level > 0, first, mi.Vector3f(1, 0, 0))
        second = dr.cross(seen, first)
        radius, angle = dr.sqrt(s), 2 * dr.pi * t
        a, b = radius * dr.cos(angle), radius * dr.sin(angle)
        share = (1 + seen.z) / 2
        b = (1 - share) * dr.sqrt(clip(dr, 1 - a * a, 0, 1)) + share * b
        up = dr.sqrt(clip(dr, 1 - a * a - b * b, 0, 1))
        slope = first * a + second * b + seen * up
        facet = mi.Vector3f(alpha * slope.x, alpha * slope.y, clip(dr, slope.z, 1e-6, 1))
        facet = frame.to_world(dr.normalize(facet))
        return dr.normalize(facet * (2 * dr.dot(self.to_eye, facet)) - self.to_eye)

    def _spread(self, half: Any) -> Any:
        """Pi D of the facets."""
        dr, square = self.dr, self.square
        across = dr.dot(self.normal, half)
        return square / dr.square(dr.square(across) * (square - 1) + 1)


def clip(dr: Any, value: Any, low: Any, high: Any) -> Any:
    """As dr.clip, whose minimum and maximum some versions of LLVM cannot compile."""
    return dr.select(value < low, low, dr.select(value > high, high, value))


_MATT = Gloss(roughness=1.0, specular=0.0)
# Fractional parts of the roots of 2, 3, 5 and 7 in 32 bit fixed point: a sequence in four
# dimensions, which beside the pixel's R2 is one in six.
_STEPS = (1779033703, 3144134277, 1013904242, 2773480762)


class GlossyScene(JitScene):
    """A scene for the compiled variants with `Body.gloss` and `Scene.area`.

    Its kernel is another one, so that scenes without either keep theirs, and its bytes.
    """

    def __init__(self, mi: Any, scene: Scene, solid: Solid) -> None:
        super().__init__(mi, scene, solid)
        kinds = [body.gloss or _MATT for body in scene.bodies]
        self._body = mi.UInt32(self.faces.body)
        numbers = [(kind.alpha**2, kind.refractive_index) for kind in kinds]
        columns = np.array(numbers, dtype=np.float32).T
        self._square, self._index = map(mi.Float, np.ascontiguousarray(columns))
        tables = np.concatenate([kept_back(kind) for kind in kinds])
        self._kept_back = mi.Float(tables.astype(np.float32))
        self._area = scene.area
        if scene.area is not None:
            self._area_axes, self._area_origin = self._pose(scene.area.world_from_light)
            self._area_half = self._opaque(scene.area.side_m / 2)
            self._area_radiance = self._opaque(scene.area.radiance)

    def _lamp_samples(self, place: Any, seed: int) -> Callable[[Any], list[Any]]:
        """Numbers in 0..1 for each sample: two for a place on the area light, two for a facet."""
        mi, dr = self._mi, self._dr
        if self._area is None:
            return lambda index: []

        def shifts(salt: int) -> Any:  # neither of the salts is the pixel's own
            return mi.sample_tea_32(place, dr.opaque(mi.UInt32, (seed ^ ~salt) % 2**32))

        pairs = list(zip([*shifts(1), *shifts(2)], _STEPS, strict=True))
        return lambda index: [
            mi.Float(shift + index * mi.UInt32(step)) * TO_UNIT for shift, step in pairs
        ]

    def _shade(self, ray: Any, lamp: Any) -> Any:
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)

        def none(face: Any, point: Any, way: Any, numbers: list[Any]) -> Any:
            return mi.Float(0)

        # A branch, not a mask: beside the object, which is much of a window, nothing is computed.
        seen = hit.prim_index, ray.o + hit.t * ray.d, mi.Vector3f(ray.d), lamp
        return dr.if_stmt(seen, hit.is_valid(), self._reflected, none)

    def _reflected(self, face: Any, point: Any, way: Any, numbers: list[Any]) -> Any:
        """Radiance of a face at a point that is seen along `way`."""
        mi, dr = self._mi, self._dr
        valid = mi.Bool(True)
        normal = dr.gather(mi.Normal3f, self._normal, face)
        to_eye = dr.normalize(-way)
        facing = mi.Vector3f(normal * dr.sign(dr.dot(normal, to_eye)))
        albedo = dr.gather(mi.Float, self._albedo, face)
        diffuse, facets = self._surface(face, valid, albedo, facing, to_eye)
        total = albedo * self._ambient
        if self._projector is not None:
            projected = self._projected(mi.Ray3f(point, way), point, normal, valid)
            shine = facets.times_pi(dr.normalize(self._slide_origin - point))
            # Where the light is opposite to the eye there is no half-way.
            total += dr.select(projected > 0, (diffuse + shine) * projected, 0)
        if self._area is not None:
            total += self._from_area(point, facing, valid, numbers, diffuse, facets)
        return total

    def _surface(
        self, face: Any, valid: Any, albedo: Any, normal: Any, to_eye: Any
    ) -> tuple[Any, Facets]:
        """Pi f of the Lambertian part, and the facets."""
        mi, dr = self._mi, self._dr
        body = dr.gather(mi.UInt32, self._body, face, valid)
        square, index = (
            dr.gather(mi.Float, values, body, valid) for values in (self._square, self._index)
        )
        facets = Facets(mi, dr, normal, to_eye, square, index)
        place = facets.cos_o * (COSINES - 1)
        low = mi.UInt32(clip(dr, place, 0, COSINES - 2))
        left, right = (
            dr.gather(mi.Float, self._kept_back, body * COSINES + low + i, valid) for i in (0, 1)
        )
        kept = dr.lerp(left, right, place - mi.Float(low))
        return albedo * (1 - kept), facets

    def _from_area(
        self, point: Any, facing: Any, valid: Any, lamp: Any, diffuse: Any, facets: Facets
    ) -> Any:
        """Radiance by one place on the area light, and of its reflex also by one facet.

        Both are weighed by their densities (Veach's balance heuristic): a reflex narrower than the
        light is rarely met by places on the light, and a wider one rarely by facets.
        """
        dr = self._dr
        start = point + facing * self._epsilon
        seen_from = start - self._area_origin
        x, y, z = (dr.dot(axis, seen_from) for axis in self._area_axes)
        before = valid & (z > 0)
        z = dr.select(before, z, 1)
        ends = [
            -self._area_half - x,
            self._area_half - x,
            -self._area_half - y,
            self._area_half - y,
        ]
        u, v, solid_angle = self._on_square(ends, z, lamp[0], lamp[1])
        ax, ay, az = self._area_axes
        there = ax * u + ay * v - az * z
        way = dr.normalize(there)
        cosine = dr.dot(facing, way)
        lit = before & (cosine > 0) & (solid_angle > 0)
        shine = facets.times_pi(way) / (1 + solid_angle * facets.density(way))
        light = cosine * solid_angle * (diffuse + shine)
        total = self._arriving(light, start + there, start, lit, coherent=False)

        way = facets.reflected(lamp[2], lamp[3])
        cosine = dr.dot(facing, way)
        along = -dr.dot(az, way)
        there = way * (z / dr.select(along > 1e-6, along, 1))
        u, v = dr.dot(ax, there), dr.dot(ay, there)
        met = before & (cosine > 0) & (along > 1e-6)
        met &= (u >= ends[0]) & (u <= ends[1]) & (v >= ends[2]) & (v <= ends[3])
        shine = facets.times_pi(way) * solid_angle / (1 + solid_angle * facets.density(way))
        total += self._arriving(cosine * shine, start + there, start, met, coherent=False)
        return total * self._area_radiance / dr.pi

    def _on_square(self, ends: list[Any], z: Any, s: Any, t: Any) -> tuple[Any, Any, Any]:
        """A place on the light, drawn evenly over the solid angle that it fills, and that angle.

        After Urena, Fajardo and King, "An Area-Preserving Parametrization for Spherical
        Rectangles", EGSR 2013. `ends` are x0, x1, y0, y1 of its sides from the point, `z` > 0 the
        distance of its plane; `s` and `t` are drawn from 0..1.
        """
        dr = self._dr
        x0, x1, y0, y1 = ends
        # z of the normals of the planes through the point and each side
        sides = [a * dr.rsqrt(a * a + z * z) for a in (-y0, x1, y1, -x0)]
        corners = [dr.acos(clip(dr, -sides[i] * sides[(i + 1) % 4], -1, 1)) for i in range(4)]
        rest = 2 * dr.pi - corners[2] - corners[3]
        solid_angle = clip(dr, corners[0] + corners[1] - rest, 0, 2 * dr.pi)
        angle = s * solid_angle + rest
        sine = dr.sin(angle)
        slope = (dr.cos(angle) * sides[0] - sides[2]) / dr.select(sine == 0, 1e-9, sine)
        cosine = dr.copysign(dr.rsqrt(slope * slope + sides[0] * sides[0] + 1e-12), slope)
        cosine = clip(dr, cosine, -1, 1)
        u = clip(dr, cosine * z * dr.rsqrt(clip(dr, 1 - cosine * cosine, 1e-12, 1)), x0, x1)
        distance = dr.sqrt(u * u + z * z)
        low, high = (y * dr.rsqrt(distance * distance + y * y) for y in (y0, y1))
        level = dr.lerp(low, high, t)
        v = level * distance * dr.rsqrt(clip(dr, 1 - level * level, 1e-7, 1))
        return u, clip(dr, v, y0, y1), solid_angle
