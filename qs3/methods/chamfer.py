"""Chamfer distance between parts of two clouds.

Fan, Su, Guibas, "A Point Set Generation Network for 3D Object Reconstruction from a Single Image",
CVPR 2017, eq. 1, with means in place of sums; restricted to marked points as in DefRec.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from qs3.geometry.device import exact_products
from qs3.geometry.neighbours import gather


def masked_chamfer(
    a: Float[Tensor, "b n 3"],
    b: Float[Tensor, "b m 3"],
    mask_a: Bool[Tensor, "b n"],
    mask_b: Bool[Tensor, "b m"],
) -> Float[Tensor, " b"]:
    """mean_i min_j |a_i - b_j|^2 + mean_j min_i |a_i - b_j|^2, over marked i and j only.

    In squared units of the clouds, >= 0; 0 for a cloud in which nothing is marked (in a or b).
    float32 at least, also under autocast. Nearest points are found without gradient; the
    gradient is that of the distances to them, as that of the minimum.
    """
    with torch.autocast(a.device.type, enabled=False):
        a, b = (x.float() if x.dtype in (torch.float16, torch.bfloat16) else x for x in (a, b))
        to_b, to_a = nearest(a.detach(), b.detach(), mask_a, mask_b)
        forth = (a - gather(b, to_b)).square().sum(2)  # [b, n]
        back = (b - gather(a, to_a)).square().sum(2)  # [b, m]
        both = mask_a.any(1, keepdim=True) & mask_b.any(1, keepdim=True)
        return masked_mean(forth, mask_a & both) + masked_mean(back, mask_b & both)


def nearest(a: Tensor, b: Tensor, mask_a: Tensor, mask_b: Tensor) -> tuple[Tensor, Tensor]:
    """For each a the nearest marked b [b, n], for each b the nearest marked a [b, m].

    By distances in the dtype of a and b, also under autocast.
    """
    with torch.autocast(a.device.type, enabled=False), exact_products():
        squares = -2 * a @ b.transpose(1, 2)  # [b, n, m]
    squares += a.square().sum(2)[:, :, None]
    squares += b.square().sum(2)[:, None]
    squares.masked_fill_(~(mask_a[:, :, None] & mask_b[:, None]), torch.inf)
    return squares.argmin(2), squares.argmin(1)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of the marked values of each row, 0 without any: [b, n] -> [b]."""
    return torch.where(mask, values, 0.0).sum(1) / mask.sum(1).clamp_min(1)
