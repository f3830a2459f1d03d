"""Further clouds of a scanned object that only a simulation has: its twins.

They lie in the dataset beside `points.npy`, where `generate.py` was asked for them (`twins=`), and
change no byte of it. All are [N, P, 3] float32, in the frame and with the P of "points":

    points_whole              whole: samples of the placed mesh's whole surface
    points_exact              exact: where each point of "points" would be without error
    points_view0, ...         views: the points of one view each
    points_view0_exact, ...   both: where those would be without error
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float, Int

from qs3.geometry.sampling import farthest_point_sampling_np, surface_sample
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthFrame
from qs3.utils.seeding import object_rng

WHOLE, EXACT, VIEWS = "whole", "exact", "views"
TWINS = (WHOLE, EXACT, VIEWS)
_DENSE = 8  # as many samples a point of the result: views have as many pixels, or more
Views = Mapping[int, tuple[np.ndarray, np.ndarray]]
"""What each view gave that gave points, by its number: [M, 3] measured, and [M, 3] true."""


def whole_surface(
    placed: Mesh, object_id: str, seed: int, points: int
) -> Float[np.ndarray, "points 3"]:
    """Points of the whole surface, as infinitely many ideal views from all sides would give.

    And of what no view sees, such as the inside of a cabinet. In the order of farthest point
    sampling, as all clouds of a dataset.

    Args:
        placed: the mesh where it was scanned, in metres.
        object_id, seed: of the object and the dataset; nothing else decides which points.
        points: how many.
    """
    rng = object_rng(seed, object_id, 0, 2)
    dense = surface_sample(placed.vertices, placed.faces, _DENSE * points, rng).astype(np.float32)
    return dense[farthest_point_sampling_np(dense, points)]


def true_points(
    frame: DepthFrame,
    depth_m: Float[np.ndarray, "h w"],
    measured: Float[np.ndarray, "m 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "m 3"]:
    """Where the points `measured` of the pixels `depth_m` would be without error, in metres.

    That is the true depth along the pixel's true ray: neither the pose nor the principal point that
    were believed enter.

    A pixel behind which the object is not (its surroundings, or nothing, where a matcher's patch
    reached over an edge) has no truth of this object: its point stays as it was measured.

    Args:
        frame: the view.
        depth_m: its depth, masked; pixels that are not finite are left out.
        measured: what `frame.points(depth_m, ...)` gave, with the pose that was believed.
        world_from_camera: the true pose.
    """
    used = np.isfinite(depth_m)
    known = used & (frame.label == 1) & np.isfinite(frame.clean_m)
    depth = np.where(known, frame.clean_m, np.where(used, 1.0, np.nan))
    true = frame.points(depth, world_from_camera, frame.true_lens)
    return np.where(known[used][:, None], true, measured)


def fused_twins(
    wanted: Collection[str], views: Views, count: int, order: Int[np.ndarray, " p"]
) -> dict[str, Float[np.ndarray, "p 3"]]:
    """The twins "exact" and "views" of a cloud that was fused of several views, by array.

    A view that gave no points repeats the one before it, or the first that did.

    Args:
        wanted: of `TWINS`.
        views: at least one.
        count: of all views, with those that gave nothing.
        order: which of the fused points, in the order of `views`, make the cloud.
    """
    arrays = {}
    if EXACT in wanted:
        true = np.concatenate([true for _, true in views.values()])
        arrays["points_exact"] = true[order].astype(np.float32)
    if VIEWS in wanted:
        last = next(iter(views))
        for i in range(count):
            last = i if i in views else last
            measured, true = (part.astype(np.float32) for part in views[last])
            own = farthest_point_sampling_np(measured, len(order))
            arrays[f"points_view{i}"] = measured[own]
            if EXACT in wanted:
                arrays[f"points_view{i}_exact"] = true[own]
    return arrays
