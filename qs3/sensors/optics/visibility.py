"""Why a pixel has no depth, and who sees what: other places' views, by rendering.

A point lamp at another place with a white slide lights exactly what can be seen from there, so any
renderer answers, with its own geometry.
"""

from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Projector, Renderer, Scene


class Reason(IntEnum):
    """One for each pixel; where several hold, the sensor decides (`first_reason`)."""

    OK = 0  # it has a depth
    EMPTY = 1  # no surface there, or none in reach
    SHADOW = 2  # the projector does not reach the surface
    OCCLUDED = 3  # the other camera does not see the surface
    OUTSIDE = 4  # the other image, or the pattern, ends before it
    DARK = 5  # too little light or contrast
    SATURATED = 6  # too much light
    AMBIGUOUS = 7  # several places match as well
    INCONSISTENT = 8  # matching the other way round gives another place
    RANGE = 9  # a depth was found, outside the range of the sensor
    FILTERED = 10  # a depth was found and a filter removed it
    UNMATCHED = 11  # none of these, or the matcher does not tell


def first_reason(causes: Mapping[Reason, np.ndarray], otherwise: Reason) -> np.ndarray:
    """[h, w] uint8: of each pixel the first reason whose mask [h, w] holds, else `otherwise`."""
    reasons = [np.uint8(reason) for reason in causes]
    return np.select(list(causes.values()), reasons, np.uint8(otherwise)).astype(np.uint8)


def white_lamp(world_from_lamp: np.ndarray) -> Projector:
    """A point lamp at a pose [4, 4]; it lights all before it, white at 1 m to radiance 1."""
    return Projector(world_from_lamp, np.ones((2, 2), dtype=np.float32), tan_half_width=10.0)


def reached_from(
    bodies: tuple[Body, ...], camera: Camera, world_from_source: np.ndarray, renderer: Renderer
) -> np.ndarray:
    """[h, w] bool: whether any part of the surface in each pixel is seen from another place, too.

    `world_from_source` [4, 4] is the pose of the other camera or the projector, which looks along
    its +z; what lies behind it is not reached.
    """
    white = tuple(replace(body, albedo=1.0, gloss=None) for body in bodies)
    scene = Scene(white, white_lamp(world_from_source))
    (image,) = renderer.render(scene, [camera], seed=0, geometry=[False])
    return image.radiance > 0


def explained(
    reason: np.ndarray, clean_m: np.ndarray, lit: np.ndarray, seen: np.ndarray | None
) -> np.ndarray:
    """Reasons that geometry gives, put before the [h, w] uint8 `reason` of matcher and filters.

    `clean_m` [h, w] is the true depth, inf where nothing is; `lit` and `seen` [h, w] bool what
    projector and other camera reach.
    """
    out = reason.copy()
    invalid = reason != Reason.OK
    if seen is not None:
        out[invalid & ~seen] = Reason.OCCLUDED
    out[invalid & ~lit] = Reason.SHADOW
    out[invalid & ~np.isfinite(clean_m)] = Reason.EMPTY
    return out


def sample_centres(camera: Camera, renderer: Renderer, seed: int) -> np.ndarray:
    """[h, w] float64: the mean column of each pixel's samples, in px of the whole image.

    A renderer spreads its samples over a pixel at random, and their mean misses the pixel's centre
    by some hundredths of a pixel (0.05 px with Mitsuba's 16 samples, measured). A camera's pixel
    has no such fluctuation; of fringes it is several times the noise. It depends on the seed and
    the pixel but not on the scene, so that it can be measured: on a plane in front of the camera,
    lit from the camera by a slide that is a ramp. `seed` is that of the images to correct, which
    are rendered with one camera a call.
    """
    k, window = camera.intrinsics, camera.rendered
    if getattr(renderer, "even", False):
        columns = window.left + np.arange(window.width, dtype=np.float64)
        return np.broadcast_to(columns, (window.height, window.width))
    ends_x = np.abs(np.array([window.left - 1, window.left + window.width]) - k.cx_px)
    ends_y = np.abs(np.array([window.top - 1, window.top + window.height]) - k.cy_px)
    room = 1.1  # the plane and the slide are larger than the view by this factor
    half = room * float(max(ends_x.max(), ends_y.max())) / k.focal_px
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half * room
    local = np.column_stack([corners, np.ones(4)])
    pose = camera.world_from_camera
    vertices = local @ pose[:3, :3].T + pose[:3, 3]
    plane = Body(Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])), albedo=1.0)
    # At least as fine as the pixels: hardware interpolates with few bits between two of them.
    count = int(np.ceil(2 * half * k.focal_px))
    ramp = (np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count)
    slide = np.broadcast_to(ramp, (count, count))
    # A plane at distance 1 that faces a projector of strength 1 shows the slide itself.
    projector = Projector(pose, np.ascontiguousarray(slide), half)
    (image,) = renderer.render(Scene((plane,), projector), [camera], seed=seed, geometry=[False])
    place = half * (2 * image.radiance.astype(np.float64) - 1)
    return place * k.focal_px + k.cx_px
