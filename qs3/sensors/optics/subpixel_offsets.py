"""Where in its pixel a renderer looks: the mean place of a pixel's samples.

A renderer spreads its samples over a pixel by chance, and their mean misses the pixel's centre by
some hundredths of a pixel (0.05 px with Mitsuba's 16 samples, measured). A camera's pixel has no
such fluctuation. Block matching does not see it; fringes do, where it is several times their noise.
It depends on the seed and the pixel but not on the scene, so that it can be measured: on a plane
before the camera, lit from the camera by a slide that is a ramp.
"""

from __future__ import annotations

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Projector, Renderer, Scene

_ROOM = 1.1  # the plane and the slide are larger than the view by this factor


def sample_centres(
    camera: Camera, renderer: Renderer, seed: int, *, along_rows: bool
) -> np.ndarray:
    """The mean column, or with `along_rows` the mean row, of each pixel's samples.

    Args:
        camera: with its window.
        renderer: asked for one image.
        seed: of the images that are to be corrected, rendered with one camera a call.

    Returns:
        [h, w] float64, in px of the whole image: u (or v) plus some hundredths.
    """
    k, window = camera.intrinsics, camera.rendered
    ends_x = np.abs(np.array([window.left - 1, window.left + window.width]) - k.cx_px)
    ends_y = np.abs(np.array([window.top - 1, window.top + window.height]) - k.cy_px)
    half = _ROOM * float(max(ends_x.max(), ends_y.max())) / k.focal_px
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half * _ROOM
    local = np.column_stack([corners, np.ones(4)])
    pose = camera.world_from_camera
    vertices = local @ pose[:3, :3].T + pose[:3, 3]
    plane = Body(Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])), albedo=1.0)
    # At least as fine as the pixels: hardware interpolates with few bits between two of them.
    count = int(np.ceil(2 * half * k.focal_px))
    ramp = (np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count)
    slide = np.broadcast_to(ramp[:, None] if along_rows else ramp, (count, count))
    # A plane at distance 1 that faces a projector of strength 1 shows the slide itself.
    projector = Projector(pose, np.ascontiguousarray(slide), half)
    (image,) = renderer.render(Scene((plane,), projector), [camera], seed=seed, geometry=[False])
    place = half * (2 * image.radiance.astype(np.float64) - 1)
    return place * k.focal_px + (k.cy_px if along_rows else k.cx_px)
