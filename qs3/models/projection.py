"""Depth images of a cloud from six sides (Goyal et al., "SimpleView", ICML 2021, section 4).

Pinhole cameras 1.4 from the origin look at it, with a field of view of 90° (the focal length is
half the image). What the released projection resolves to:

    view   row axis   column axis   depth - 1.4   camera at
    0      -y         +x            +z            (0, 0, -1.4)
    1      -y         -z            +x            (-1.4, 0, 0)
    2      -y         -x            -z            (0, 0, 1.4)
    3      -y         +z            -x            (1.4, 0, 0)
    4      -z         +x            -y            (0, 1.4, 0)
    5      +z         +x            +y            (0, -1.4, 0)

A point fills one pixel: row ceil(u - 1/2) with u = (row coordinate / depth + 1) size / 2, the
column likewise. Points behind the camera or outside the frame are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

CAMERA_DISTANCE = 1.4
VIEWS = 6
# (axis, sign) of row, column and depth
_TABLE = (
    ((1, -1), (0, 1), (2, 1)),
    ((1, -1), (2, -1), (0, 1)),
    ((1, -1), (0, -1), (2, -1)),
    ((1, -1), (2, 1), (0, -1)),
    ((2, -1), (0, 1), (1, -1)),
    ((2, 1), (0, 1), (1, 1)),
)
_TINY = 1e-12  # of the released code: no division by zero


@torch.no_grad()
def depth_images(
    points: Float[Tensor, "b n 3"],
    size: int = 128,
    *,
    views: Sequence[int] = tuple(range(VIEWS)),
    up: str = "y",
    pixel: str = "harmonic",
) -> Float[Tensor, "b v size size"]:
    """Depth per pixel, 0 where no point falls; no gradient reaches the points.

    Args:
        points: clouds about the origin, radius about 1.
        size: rows and columns of an image.
        views: rows of the table, in this order.
        up: the axis of the clouds that the cameras 0 to 3 see upright. "y": the table as it is,
            which is what the released code does, with QS3's z-up data too. "z": the clouds are
            turned by -90° about x first.
        pixel: depth where several points share a pixel. "harmonic": their harmonic mean, as
            released. "nearest": the smallest.

    Returns:
        float32, or float64 for float64 points; also under autocast.
    """
    with torch.autocast(points.device.type, enabled=False):
        x, y, z = points.to(torch.promote_types(points.dtype, torch.float32)).unbind(2)
        if up == "z":
            y, z = z, -y
        return _draw(torch.stack([x, y, z]), size, views, pixel)


def _draw(axes: Tensor, size: int, views: Sequence[int], pixel: str) -> Tensor:
    signed = torch.stack([-axes, axes])  # views of it: a table would have to be carried there
    entries = [signed[(sign + 1) // 2, axis] for v in views for axis, sign in _TABLE[v]]
    rows, columns, depth = torch.stack(entries).unflatten(0, (len(views), 3)).unbind(1)
    depth = depth + CAMERA_DISTANCE  # [v, b, n]
    row = ((rows / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
    column = ((columns / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
    seen = (row >= 0) & (row < size) & (column >= 0) & (column < size) & (depth >= 0)
    where = torch.where(seen, row * size + column, size**2).long()  # the last one is none of them
    empty = torch.zeros_like(depth[:, :, :1]).repeat(1, 1, size**2 + 1)
    if pixel == "nearest":
        flat = (empty + torch.inf).scatter_reduce(2, where, depth, "amin")
        flat = torch.where(flat == torch.inf, 0, flat)
    else:
        weight = torch.where(seen, 1 / (depth + _TINY), 0)
        total = empty.scatter_add(2, where, weight)
        flat = empty.scatter_add(2, where, depth * weight)
        flat = flat / torch.where(total == 0, 1, total)
    return flat[:, :, :-1].transpose(0, 1).unflatten(2, (size, size)).contiguous()
