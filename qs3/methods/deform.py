"""Deformation of a region: the points of one voxel are replaced by a small blob at its centre.

"Volume-based voxels" of DefRec: Achituve, Maron, Chechik, "Self-Supervised Learning for Domain
Adaptation on Point Clouds", WACV 2021, section 3.1; GAST asks which voxel it was.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

GRID = 3
VOXELS = GRID**3
_STD = 0.001**0.5  # of the blob: the covariance is 0.001 I
_OF = 1024  # points of the clouds for which `min_points` are stated


class Deformed(NamedTuple):
    """Clouds with one voxel deformed.

    Attributes:
        points: [B, N, 3].
        mask: [B, N] the points that were replaced; none where no voxel had enough points.
        voxel: [B] the voxel, 0 to 26; meaningless where the mask is empty.
    """

    points: Float[Tensor, "b n 3"]
    mask: Bool[Tensor, "b n"]
    voxel: Int[Tensor, " b"]


def voxel_of(points: Float[Tensor, "b n 3"]) -> Int[Tensor, "b n"]:
    """Voxel 9 i + 3 j + k of each point, in a grid of 3 x 3 x 3 on [-1, 1]^3.

    Half-open voxels [low, high); points outside belong to the nearest one. (The released code
    has open ones: a point on a border falls into voxel 0, wherever it is.)
    """
    cell = ((points.float() + 1) * (GRID / 2)).floor().long().clamp(0, GRID - 1)  # [b, n, 3]
    return (cell[..., 0] * GRID + cell[..., 1]) * GRID + cell[..., 2]


def voxel_centre(voxel: Int[Tensor, " b"]) -> Float[Tensor, "b 3"]:
    """Centre of a voxel: -2/3, 0 or 2/3 in each coordinate."""
    cell = torch.stack([voxel // GRID**2, voxel // GRID % GRID, voxel % GRID], dim=1)
    return (cell + 0.5) * (2 / GRID) - 1


def cloud_size(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 1 1"]:
    """Largest distance of a point from the origin; 1 where all points lie there."""
    size = points.norm(dim=2).amax(dim=1)[:, None, None]
    return torch.where(size > 0, size, 1)


def deform(points: Float[Tensor, "b n 3"], generator: torch.Generator, min_points: int) -> Deformed:
    """Deform one voxel of each cloud.

    The voxel is the first, in a random order that the batch shares, which holds at least
    `min_points` points in 1,024 of the cloud's: papers and codes say how many for clouds of that
    size, and a cloud of a quarter of the points has a quarter of them in each voxel. Its points
    become draws from N(centre, 0.001 I). The input is left alone.
    """
    b, n, _ = points.shape
    device = points.device
    order = torch.randperm(VOXELS, generator=generator, device=generator.device).to(device)
    noise = torch.randn(b, n, 3, generator=generator, device=generator.device).to(points)
    of = voxel_of(points)  # [b, n]
    counts = torch.zeros(b, VOXELS, dtype=torch.int64, device=device)
    counts.scatter_add_(1, of, torch.ones_like(of))
    enough = _OF * counts[:, order] >= n * min_points  # [b, 27], in the random order
    voxel = order[enough.int().argmax(1)]  # the first True
    mask = (of == voxel[:, None]) & enough.any(1, keepdim=True)
    blob = voxel_centre(voxel).to(points.dtype)[:, None] + _STD * noise  # [b, n, 3]
    return Deformed(torch.where(mask[:, :, None], blob, points), mask, voxel)
