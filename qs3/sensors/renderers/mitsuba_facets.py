"""The reflecting facets of `gloss`, for Mitsuba's compiled variants."""

from __future__ import annotations

from typing import Any


class Facets:
    """Facets of the surfaces that a bundle of rays meets, by unit vectors.

    Attributes:
        cos_o: cosine of the angle to the eye.
    """

    def __init__(
        self,
        mi: Any,
        normal: Any,
        to_eye: Any,
        square: Any,
        refractive_index: Any,
        metal: Any,
        albedo: Any,
    ) -> None:
        """`normal` is on the eye's side; `square` is alpha^2, the rest as in `gloss`."""
        import drjit as dr

        self._mi, self._dr = mi, dr
        self._normal, self._to_eye, self._square = normal, to_eye, square
        self._index, self._metal, self._albedo = refractive_index, metal, albedo
        self.cos_o = clip(dr, dr.dot(normal, to_eye), 1e-6, 1)

    def times_pi(self, to_light: Any) -> Any:
        """Pi f of the facets alone; see `gloss.times_pi`."""
        dr, square = self._dr, self._square
        cos_i = clip(dr, dr.dot(self._normal, to_light), 1e-6, 1)
        half = dr.normalize(to_light + self._to_eye)
        seen = 0.5 / (
            cos_i * dr.sqrt(square + (1 - square) * dr.square(self.cos_o))
            + self.cos_o * dr.sqrt(square + (1 - square) * dr.square(cos_i))
        )
        met = clip(dr, dr.dot(self._to_eye, half), 0, 1)
        g = dr.sqrt(dr.square(self._index) - 1 + dr.square(met))
        other = (met * (g + met) - 1) / (met * (g - met) + 1)
        dielectric = 0.5 * dr.square((g - met) / (g + met)) * (1 + dr.square(other))
        metal = self._albedo + (1 - self._albedo) * (1 - met) ** 5
        return self._spread(half) * seen * dr.select(self._metal, metal, dielectric)

    def density(self, to_light: Any) -> Any:
        """Density of `reflected` over the solid angle (Heitz, JCGT 2018, eq. 17)."""
        dr, square = self._dr, self._square
        half = dr.normalize(to_light + self._to_eye)
        masking = self.cos_o + dr.sqrt(square + (1 - square) * dr.square(self.cos_o))
        return self._spread(half) / (2 * dr.pi * masking)

    def reflected(self, s: Any, t: Any) -> Any:
        """Where a facet sends the ray from the eye; one of those that the eye sees, as Heitz draws.

        `s` and `t` are drawn from 0..1.
        """
        mi, dr = self._mi, self._dr
        alpha, frame = dr.sqrt(self._square), mi.Frame3f(self._normal)
        eye = frame.to_local(self._to_eye)
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
        return dr.normalize(facet * (2 * dr.dot(self._to_eye, facet)) - self._to_eye)

    def _spread(self, half: Any) -> Any:
        """Pi D of the facets."""
        dr, square = self._dr, self._square
        across = dr.dot(self._normal, half)
        return square / dr.square(dr.square(across) * (square - 1) + 1)


def clip(dr: Any, value: Any, low: Any, high: Any) -> Any:
    """As dr.clip, whose minimum and maximum some versions of LLVM cannot compile."""
    return dr.select(value < low, low, dr.select(value > high, high, value))
