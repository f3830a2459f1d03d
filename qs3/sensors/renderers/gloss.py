"""Surfaces that are not matt: the principled model's base layers, one definition for all renderers.

A glossy surface is a Lambertian one below a dielectric with rough facets: what the Principled BSDF
of Blender 4 gives with base colour, roughness and specular level alone, its distribution set to
GGX. With unit vectors to the light (i), to the eye (o) and half-way (h)

    f(i, o) = (1 - M(o)) albedo / pi + D(h) V(i, o) F(o . h)

D and V are Trowbridge and Reitz's facets (Walter et al., EGSR 2007, eq. 33 and 34) with alpha =
roughness^2 and masking correlated by height (Heitz, JCGT 2014, eq. 99). F of a dielectric is
Fresnel's for the refractive index whose reflectance at normal incidence is 0.08 specular; M is its
mean over the facets that are seen from o. Light is not passed on from facet to facet.
"""

import functools
from dataclasses import dataclass

import numpy as np

COSINES = 33
"""Entries of `kept_back`, at cosines 0 to 1."""
_FACETS = 24  # squared: facets that a mean is taken over


@dataclass(frozen=True)
class Gloss:
    """How a surface shines, beside its albedo; the defaults are those of Blender's Principled BSDF.

    Attributes:
        roughness: 0.1..1, which is nearly matt; below 0.1 a point light's reflex is smaller than
            a pixel.
        specular: 0..1, of a dielectric, reflectance at normal incidence over 0.08; 0.5 is glass or
            plastic (refractive index 1.5), 0 leaves the Lambertian part alone.
    """

    roughness: float = 0.5
    specular: float = 0.5

    @property
    def alpha(self) -> float:
        """Width of the facets' slopes."""
        return self.roughness**2

    @property
    def refractive_index(self) -> float:
        """Refractive index of the dielectric."""
        root = (0.08 * self.specular) ** 0.5
        return (1 + root) / (1 - root)


def fresnel(gloss: Gloss, cosine: np.ndarray) -> np.ndarray:
    """Share of unpolarised light that a dielectric facet reflects, by the cosine of incidence."""
    g = np.sqrt(gloss.refractive_index**2 - 1 + cosine**2)
    other = (cosine * (g + cosine) - 1) / (cosine * (g - cosine) + 1)
    return 0.5 * ((g - cosine) / (g + cosine)) ** 2 * (1 + other**2)


@functools.lru_cache(maxsize=1024)
def kept_back(gloss: Gloss) -> np.ndarray:
    """[COSINES] M(o) by the cosine of o: what does not reach the Lambertian part.

    The mean over the facets seen from o (drawn as Heitz, JCGT 2018, does), each weighed by the
    share of its reflected light that is not blocked.
    """
    if gloss.specular == 0:
        return np.zeros(COSINES)
    alpha = gloss.alpha
    cosine = np.maximum(np.linspace(0, 1, COSINES), 1e-3)[:, None]
    middles = (np.arange(_FACETS) + 0.5) / _FACETS
    radius, angle = (a.ravel() for a in np.meshgrid(np.sqrt(middles), 2 * np.pi * middles))
    # From the eye, stretched to facets of slope 1, in the plane x z; x across, y aside.
    x, z = alpha * np.sqrt(1 - cosine**2), cosine
    x, z = x / np.hypot(x, z), z / np.hypot(x, z)
    across, aside = radius * np.cos(angle), radius * np.sin(angle)
    share = (1 + z) / 2
    aside = (1 - share) * np.sqrt(1 - across**2) + share * aside
    along = np.sqrt(np.maximum(0, 1 - across**2 - aside**2))
    slopes = np.stack([x * along - z * aside, across + 0 * z, np.maximum(z * along + x * aside, 0)])
    facet = slopes * np.array([alpha, alpha, 1.0])[:, None, None]
    facet = facet / np.linalg.norm(facet, axis=0)
    eye = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine])
    met = (eye * facet).sum(axis=0)
    out = np.maximum(2 * met * facet[2] - cosine, 0)  # z of the reflected ray

    def slope_term(c: np.ndarray) -> np.ndarray:
        return np.sqrt(1 + alpha**2 * (1 / np.maximum(c, 1e-6) ** 2 - 1)) - 1

    passed = (2 + slope_term(cosine)) / (2 + slope_term(cosine) + slope_term(out)) * (out > 0)
    reflected = fresnel(gloss, np.clip(met, 0, 1))
    mean: np.ndarray = (reflected * passed).sum(axis=1) / passed.sum(axis=1)
    return mean
