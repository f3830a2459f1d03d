"""The truth harness of `qs3.sense`: another renderer's true depth in place of its meshes."""

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import Scene
from qs3.sensors.renderers.depth import DepthRenderer


class ByDepth:
    """Asks a renderer for true depth and albedo of the first camera; makes all images of them."""

    def __init__(self, renderer):
        self.renderer, self._seen = renderer, (None, None)

    def of(self, bodies, camera):
        k, pose = camera.intrinsics, camera.world_from_camera
        whole, lit = Camera(k, pose), Scene(bodies, None, ambient=1.0)
        (true,) = self.renderer.render(lit, [whole], seed=0, geometry=[True])
        lens = (k.focal_px, k.focal_px, k.cx_px, k.cy_px)
        return DepthRenderer(true.depth_m, lens, true.radiance, 3 * k.focal_px, pose)

    def render(self, scene, cameras, *, seed, geometry):
        if self._seen[0] is not scene.bodies:
            self._seen = scene.bodies, self.of(scene.bodies, cameras[0])
        return self._seen[1].render(scene, cameras, seed=seed, geometry=geometry)


def agreement(one, other, focal_baseline):
    """Shares of pixels with the same status and reason, and the differences of disparities, px."""
    measured = np.isfinite(one.depth_m), np.isfinite(other.depth_m)
    both = measured[0] & measured[1]
    apart = np.abs(focal_baseline / one.depth_m - focal_baseline / other.depth_m)[both]
    same = (measured[0] == measured[1]).mean(), (one.reason == other.reason).mean()
    return *same, apart
