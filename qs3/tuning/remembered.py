"""A renderer that renders a view once, however much light from all sides is asked for."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import replace

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import Image, Renderer, Scene

MOST_BYTES = 1 << 30


class Remembered:
    """Keeps what was rendered of a scene, in the projector's light and in light from all sides.

    A search asks for the same view by sensors that differ in their camera or in `ambient`. A
    surface's radiance is what the projector's light leaves on it and `ambient` times what light of
    strength 1 does (`Scene.ambient`), so two renders serve all of them: the sum is that of one
    render but for the last bit of a float32. Whatever else decides an image is part of what it is
    known by. Scenes that are not plain, whose light bounces or shines, are rendered each time.

    Args:
        renderer: that renders what is not known.
        most_bytes: of images that are kept; those not asked for the longest go.
    """

    def __init__(self, renderer: Renderer, most_bytes: int = MOST_BYTES) -> None:
        self.renderer = renderer
        self.most_bytes = most_bytes
        self._known: OrderedDict[bytes, tuple[list[Image], list[Image]]] = OrderedDict()
        self._bytes = 0

    def provenance(self) -> dict[str, str]:
        """See `Renderer.provenance`."""
        return self.renderer.provenance()

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """See `Renderer.render`; the images are the caller's own."""
        if not scene.plain:
            return self.renderer.render(scene, cameras, seed=seed, geometry=geometry)
        key = _key(scene, cameras, seed, geometry)
        if key in self._known:
            self._known.move_to_end(key)
        else:
            self._keep(key, self._parts(scene, cameras, seed, geometry))
        lit, even = self._known[key]
        strength = np.float32(scene.ambient)
        return [
            Image(
                one.radiance + strength * other.radiance,
                one.depth_m.copy(),
                one.label.copy(),
                one.cosine.copy(),
            )
            for one, other in zip(lit, even, strict=True)
        ]

    def _parts(
        self, scene: Scene, cameras: list[Camera], seed: int, geometry: list[bool]
    ) -> tuple[list[Image], list[Image]]:
        """In the projector's light, which has the geometry, and in even light of strength 1."""
        render = self.renderer.render
        alone = replace(scene, projector=None, ambient=1.0)
        if scene.projector is None:
            even = render(alone, cameras, seed=seed, geometry=geometry)
            return [replace(one, radiance=np.zeros_like(one.radiance)) for one in even], even
        even = render(alone, cameras, seed=seed, geometry=[False] * len(cameras))
        dark = replace(scene, ambient=0.0)
        return render(dark, cameras, seed=seed, geometry=geometry), even

    def _keep(self, key: bytes, parts: tuple[list[Image], list[Image]]) -> None:
        self._known[key] = parts
        self._bytes += _size(parts)
        while self._bytes > self.most_bytes and len(self._known) > 1:
            _, gone = self._known.popitem(last=False)
            self._bytes -= _size(gone)


def _size(parts: tuple[list[Image], list[Image]]) -> int:
    """Bytes of all arrays."""
    return sum(
        array.nbytes
        for images in parts
        for one in images
        for array in (one.radiance, one.depth_m, one.label, one.cosine)
    )


def _key(scene: Scene, cameras: list[Camera], seed: int, geometry: list[bool]) -> bytes:
    """Of all that decides the two parts; `ambient` does not."""
    found = hashlib.sha256(repr((seed, geometry)).encode())
    for body in scene.bodies:
        for array in (body.mesh.vertices, body.mesh.faces):
            found.update(np.ascontiguousarray(array).tobytes())
        found.update(repr((body.albedo, body.label)).encode())
    projector = scene.projector
    if projector is not None:
        found.update(np.ascontiguousarray(projector.slide).tobytes())
        found.update(np.ascontiguousarray(projector.world_from_projector).tobytes())
        found.update(repr((projector.tan_half_width, projector.strength)).encode())
    for camera in cameras:
        found.update(np.ascontiguousarray(camera.world_from_camera).tobytes())
        found.update(repr((camera.intrinsics, camera.rendered)).encode())
    return found.digest()
