"""Augmentation of whole batches on their device, with an owned generator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.config.checks import check_ranges


@dataclass(frozen=True)
class Augment:
    """Random rotation about the up axis, anisotropic scale, shift and jitter, in this order.

    Attributes:
        rotate_z: turn each cloud about z by U(0, 2π).
        scale: factor of each axis, U(1 / scale, scale); 1 leaves the size alone.
        shift: added to each axis, U(-shift, shift).
        jitter_sigma: standard deviation of the noise on each coordinate.
        jitter_clip: bound of that noise. PointNet, which the paper cites, has 0.05; the code that
            the paper's descends from 0.02.
    """

    rotate_z: bool = True
    scale: float = 1.0
    shift: float = 0.0
    jitter_sigma: float = 0.01
    jitter_clip: float = 0.05

    def __post_init__(self) -> None:
        noise = dict.fromkeys(("shift", "jitter_sigma", "jitter_clip"), ">= 0")
        check_ranges(self, "protocol.augment.", scale=">= 1", **noise)

    def __call__(
        self, points: Float[Tensor, "b n 3"], generator: torch.Generator
    ) -> Float[Tensor, "b n 3"]:
        """A new batch; the one given is left alone. `generator` is on the device of `points`."""
        b, like = len(points), {"device": points.device, "dtype": points.dtype}

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, **like)  # type: ignore[call-overload]

        if self.rotate_z:
            points = rotate_z(points, 2 * math.pi * uniform(b))
        if self.scale > 1.0:
            low, high = 1 / self.scale, self.scale
            points = points * (low + (high - low) * uniform(b, 1, 3))
        if self.shift > 0.0:
            points = points + self.shift * (2 * uniform(b, 1, 3) - 1)
        if self.jitter_sigma > 0.0:
            noise = torch.randn(points.shape, generator=generator, device=points.device)
            noise = (self.jitter_sigma * noise).clamp(-self.jitter_clip, self.jitter_clip)
            points = points + noise.to(points.dtype)
        return points


def rotate_z(points: Float[Tensor, "b n 3"], angle: Float[Tensor, " b"]) -> Float[Tensor, "b n 3"]:
    """Turn each cloud about the z axis by its angle in radians, counter-clockwise from above."""
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]  # [B, 1]
    x, y, z = points.unbind(dim=2)  # [B, N] each
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], dim=2)
