"""Clouds of two parts, of which either may say the class."""

from __future__ import annotations

import torch
from torch import Tensor


def blobs(right: Tensor | None, left: Tensor, generator: torch.Generator) -> Tensor:
    """Three points at one of four corners on the right, if any, and seven at one on the left."""
    corners = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])

    def blob(classes: Tensor, side: float, n: int) -> Tensor:
        centre = torch.cat([torch.full((len(classes), 1), side), corners[classes]], 1)[:, None]
        return 0.6 * centre + 0.05 * torch.randn(len(classes), n, 3, generator=generator)

    seven = blob(left, -1.0, 7)
    return torch.cat([seven[:, :3] if right is None else blob(right, 1.0, 3), seven], 1)
