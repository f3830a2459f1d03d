"""What a renderer is asked for and what it gives back: one protocol for Blender and Mitsuba."""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.gloss import Gloss


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in the world with a surface of one kind.

    Attributes:
        mesh: world coordinates, metres.
        albedo: reflectance in the near infrared, 0..1.
        label: 0 is background (floor, walls, clutter), 1 the object that is scanned.
        gloss: how it shines; None: it is matt (Lambertian).
    """

    mesh: Mesh
    albedo: float = 0.8
    label: int = 1
    gloss: Gloss | None = None


@dataclass(frozen=True, eq=False)
class Projector:
    """A pinhole projector that throws a slide.

    It looks along its +z with x right and y down, like a camera (qs3.geometry.cameras).

    Attributes:
        world_from_projector: [4, 4].
        slide: [H, W] float32 in 0..1, row 0 at the top (towards -y), column 0 at -x.
        tan_half_width: half the width of the slide on the plane at distance 1; the height
            follows from the slide's aspect (square slide pixels). Black outside.
        strength: radiance of a white Lambertian plane that faces the projector at 1 m under
            a white slide pixel. It falls with the square of the distance along the axis
            and with the cosine of incidence, without vignetting across the slide.
    """

    world_from_projector: np.ndarray
    slide: np.ndarray
    tan_half_width: float
    strength: float = 1.0


@dataclass(frozen=True, eq=False)
class AreaLight:
    """A square that glows evenly (as Lambert says) to one side and is not seen itself.

    Attributes:
        world_from_light: [4, 4] of its middle; it shines along its +z, its sides are along x and y.
        side_m: of the square.
        radiance: of each of its points.
    """

    world_from_light: np.ndarray
    side_m: float
    radiance: float


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies, one projector, uniform light from all sides, and maybe a light with shadows.

    Attributes:
        bodies: at least one.
        projector: None for a camera that needs no pattern.
        ambient: radiance of the surroundings, which reaches every surface from all sides,
            never occluded: a surface gains albedo x ambient, glossy or not. The background of an
            image, where no body is, is 0.
        area: sampled once for each sample of a pixel, so it has a little sampling noise.
    """

    bodies: tuple[Body, ...]
    projector: Projector | None = None
    ambient: float = 0.0
    area: AreaLight | None = None

    @property
    def plain(self) -> bool:
        """Whether all is matt and there is no area light: what every variant can render."""
        return self.area is None and all(body.gloss is None for body in self.bodies)


@dataclass(frozen=True, eq=False)
class Image:
    """What one camera sees, over `camera.rendered`.

    Attributes:
        radiance: [h, w] float32, linear; a white Lambertian surface under irradiance E has
            radiance E / pi.
        depth_m: [h, w] float32, along the optical axis at the pixel's centre, inf where
            nothing is hit.
        label: [h, w] uint8, `Body.label` of what the pixel's centre sees, 0 where nothing is.
        cosine: [h, w] float32 in 0..1, cosine of the angle between the surface's normal and
            the ray through the pixel's centre, 0 where nothing is.
    """

    radiance: np.ndarray
    depth_m: np.ndarray
    label: np.ndarray
    cosine: np.ndarray

    @staticmethod
    def without_geometry(radiance: np.ndarray) -> Image:
        """An image for which no geometry was wanted."""
        shape = radiance.shape
        return Image(
            radiance,
            np.full(shape, np.inf, dtype=np.float32),
            np.zeros(shape, dtype=np.uint8),
            np.zeros(shape, dtype=np.float32),
        )


def tangents(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Tangents x / z [w] and y / z [h, 1] of the rays through the centres of rendered pixels."""
    window, k = camera.rendered, camera.intrinsics
    x = (window.left + np.arange(window.width) - k.cx_px) / k.focal_px
    y = (window.top + np.arange(window.height) - k.cy_px)[:, None] / k.focal_px
    return x, y


def incidence(normal: np.ndarray, hit: np.ndarray, camera: Camera) -> np.ndarray:
    """Cosine of the angle of incidence, for `Image.cosine`; 0 where `hit` [h, w] does not hold.

    `normal` [h, w, 3] are unit normals of what is seen, in the camera's axes.
    """
    x, y = tangents(camera)
    nx, ny, nz = np.moveaxis(normal, -1, 0)
    cosine = np.abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1)
    return np.where(hit, np.minimum(cosine, 1), 0).astype(np.float32)


class Renderer(Protocol):
    """Turns a scene into images. Not thread safe; one instance a process."""

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """Render one image a camera; the same call gives the same bytes.

        `seed` is that of the sampling pattern; `geometry` has for each camera whether depth_m,
        label and cosine are wanted, else they are inf and 0. A failure is a RenderError.
        """

    def provenance(self) -> dict[str, str]:
        """Renderer, variant and library versions: what decides the bytes it makes."""


@dataclass(frozen=True)
class RendererSettings:
    """Settings both renderers share.

    Attributes:
        samples: samples a pixel (anti-aliasing of the dots, and places on an area light; light is
            direct only).
        threads: 0 is all cores. Output must not depend on it.
    """

    samples: int = 16
    threads: int = 1


def give_memory_back() -> None:
    """Let the C library return what is free in its heap; does nothing where it cannot.

    Images of every size come and go between small blocks that stay, and glibc keeps the holes:
    tens of megabytes over 200 objects, with nothing lost. Takes about a millisecond.
    """
    if sys.platform.startswith("linux"):
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(0)
