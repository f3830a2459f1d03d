"""A renderer that gives the same image of the same scene: for noise over time, and for speed."""

from __future__ import annotations

from dataclasses import replace

from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import Image, Renderer, Scene


class StillRenderer:
    """Renders what it has not rendered yet, always with one seed; use one for each scene.

    Anti-aliasing draws its samples from the seed of a frame. Over a still scene a device has noise
    of its sensor only, so the frames of one scene must share their samples: they are told apart by
    the number of the call since `rewind`.
    """

    def __init__(self, renderer: Renderer, seed: int = 0) -> None:
        self._renderer, self._seed = renderer, seed
        self._kept: list[list[Image]] = []
        self._next = 0

    def rewind(self) -> None:
        """The next frame of the same scene begins."""
        self._next = 0

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """See `Renderer.render`."""
        if self._next == len(self._kept):
            images = self._renderer.render(scene, cameras, seed=self._seed, geometry=geometry)
            self._kept.append(images)
        images = self._kept[self._next]
        self._next += 1
        return [replace(image, radiance=image.radiance.copy()) for image in images]

    def provenance(self) -> dict[str, str]:
        """See `Renderer.provenance`."""
        return self._renderer.provenance()
