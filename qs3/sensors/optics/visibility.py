"""Who sees what: whether surfaces in an image are reached from another place, by rendering.

A point lamp at that place with a white slide lights exactly what can be seen from there, so any
renderer answers, with its own geometry.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.sensors.pixel_status import Reason
from qs3.sensors.renderers.base import Body, Projector, Renderer, Scene

_WHITE = np.ones((2, 2), dtype=np.float32)
_WIDE = 10.0  # tangent of half the lamp's angle: all that lies before it


def white_lamp(world_from_lamp: np.ndarray) -> Projector:
    """A point lamp at a pose [4, 4]; it lights all before it, white at 1 m to radiance 1."""
    return Projector(world_from_lamp, _WHITE, _WIDE)


def reached_from(
    bodies: tuple[Body, ...], camera: Camera, world_from_source: np.ndarray, renderer: Renderer
) -> np.ndarray:
    """[h, w] bool: whether the surface in each pixel can be seen from another place, too.

    `world_from_source` [4, 4] is the pose of the other camera or the projector, which looks along
    its +z; what lies behind it is not reached. A pixel counts if any part of its surface is
    reached.
    """
    white = tuple(replace(body, albedo=1.0, gloss=None) for body in bodies)
    scene = Scene(white, white_lamp(world_from_source))
    (image,) = renderer.render(scene, [camera], seed=0, geometry=[False])
    return image.radiance > 0


def explained(
    reason: np.ndarray, clean_m: np.ndarray, lit: np.ndarray, seen: np.ndarray | None
) -> np.ndarray:
    """Reasons that geometry gives, put before the [h, w] uint8 `reason` of matcher and filters.

    Args:
        clean_m: [h, w] true depth, inf where nothing is.
        lit: [h, w] bool, reached by the projector.
        seen: [h, w] bool, reached by the other camera; None if there is none.
    """
    out = reason.copy()
    invalid = reason != Reason.OK
    if seen is not None:
        out[invalid & ~seen] = Reason.OCCLUDED
    out[invalid & ~lit] = Reason.SHADOW
    out[invalid & ~np.isfinite(clean_m)] = Reason.EMPTY
    return out
