"""Augmentation of whole batches on their device, with an owned generator."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from annotated_types import Ge, Interval
from jaxtyping import Float
from torch import Tensor

from qs3.store.store import HEIGHTS
from qs3.utils.settings import settings

_SEEN_TURN = math.radians(20)  # the camera is not quite where it is thought to be


@settings
class Augment:
    """Cut, mirror, tilt, turn about z, scale, shift, lift and jitter, in this order.

    Attributes:
        crop: the smallest share of a cloud that stays when a plane cuts it (see `crop`), as the
            picture's border and nearer things cut real objects; 1 leaves it whole.
        mirror: every other cloud is mirrored, left to right.
        tilt_deg: standard deviation of small turns about x and y, as where up is estimated.
        rotate_z: turn each cloud about z by U(0, 2π), at `data.scale=seen` by U(-20°, 20°).
        scale: factor of each axis, U(1 / scale, scale); 1 leaves the size alone.
        shift: added to each axis, U(-shift, shift).
        lift: of clouds over the floor (`HEIGHTS`), and of no others, added to z alone,
            U(-lift, lift): how high a camera hangs is not known to the decimetre.
        jitter_sigma: standard deviation of the noise on each coordinate.
        jitter_clip: bound of that noise. PointNet, which the paper cites, has 0.05; the code that
            the paper's descends from 0.02.
    """

    crop: Annotated[float, Interval(gt=0, le=1)] = 1.0
    mirror: bool = False
    tilt_deg: Annotated[float, Ge(0)] = 0.0
    rotate_z: bool = True
    scale: Annotated[float, Ge(1)] = 1.0
    shift: Annotated[float, Ge(0)] = 0.0
    lift: Annotated[float, Ge(0)] = 0.0
    jitter_sigma: Annotated[float, Ge(0)] = 0.01
    jitter_clip: Annotated[float, Ge(0)] = 0.05

    def __call__(
        self,
        points: Float[Tensor, "b n 3"],
        generator: torch.Generator,
        scale: str = "unit_ball",
    ) -> Float[Tensor, "b n 3"]:
        """A new batch.

        Args:
            points: clouds as `scale` says.
            generator: on the device of `points`.
            scale: see `qs3.datamodules.clouds`; they are so again after a cut.
        """
        b, like = len(points), {"device": points.device, "dtype": points.dtype}

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, **like)  # type: ignore[call-overload]

        if self.crop < 1.0:
            points = crop(points, self.crop, generator, scale)
        if self.mirror:
            left = torch.where(uniform(b, 1) < 0.5, -points[..., 0], points[..., 0])
            points = torch.cat([left[..., None], points[..., 1:]], dim=2)
        if self.tilt_deg > 0.0:
            angles = math.radians(self.tilt_deg) * torch.randn(b, 2, generator=generator, **like)  # type: ignore[call-overload]
            points = tilt(points, angles)
        if self.rotate_z:
            turn = uniform(b)
            angle = _SEEN_TURN * (2 * turn - 1) if scale == "seen" else 2 * math.pi * turn
            points = rotate_z(points, angle)
        if self.scale > 1.0:
            low, high = 1 / self.scale, self.scale
            points = points * (low + (high - low) * uniform(b, 1, 3))
        if self.shift > 0.0:
            points = points + self.shift * (2 * uniform(b, 1, 3) - 1)
        if self.lift > 0.0 and scale in HEIGHTS:
            up = torch.arange(3, device=points.device).eq(2).to(points.dtype) * self.lift
            points = points + up * (2 * uniform(b, 1, 1) - 1)
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


def tilt(points: Float[Tensor, "b n 3"], angles: Float[Tensor, "b 2"]) -> Float[Tensor, "b n 3"]:
    """Turn each cloud about x, then about y, by its angles in radians, about its mean height."""
    cos, sin = angles.cos()[..., None], angles.sin()[..., None]  # [B, 2, 1]
    middle = points[..., 2].mean(dim=1, keepdim=True)
    x, y, z = points[..., 0], points[..., 1], points[..., 2] - middle
    y, z = cos[:, 0] * y - sin[:, 0] * z, sin[:, 0] * y + cos[:, 0] * z
    x, z = cos[:, 1] * x + sin[:, 1] * z, cos[:, 1] * z - sin[:, 1] * x
    return torch.stack([x, y, z + middle], dim=2)


def crop(
    points: Float[Tensor, "b n 3"], least: float, generator: torch.Generator, scale: str
) -> Float[Tensor, "b n 3"]:
    """Cut each cloud by a plane of any direction, so that U(least, 1) of its points stay.

    What stays is put where `scale` has it: centred again, in the unit ball scaled again, as a cloud
    whose rest was never seen; over the floor it keeps its height. Points of it are
    repeated at random in the places of the others.
    """
    b, n = points.shape[:2]
    device = points.device
    normal = torch.randn(b, 3, 1, generator=generator, device=device).to(points.dtype)
    share = least + (1 - least) * torch.rand(b, generator=generator, device=device)
    order = (points @ normal)[..., 0].argsort(dim=1, stable=True)  # [B, N]
    first = torch.arange(n, device=device) < (share * n).ceil().clamp(min=1)[:, None]
    left = torch.zeros_like(first).scatter(1, order, first)  # [B, N]
    other = torch.multinomial(left.float(), n, replacement=True, generator=generator)  # [B, N]
    centre = (points * left[..., None]).sum(dim=1) / left.sum(dim=1, keepdim=True)  # [B, 3]
    if scale in HEIGHTS:
        centre[:, 2] = 0
    moved = points - centre[:, None]
    moved = torch.where(left[..., None], moved, moved.take_along_dim(other[..., None], dim=1))
    if scale == "unit_ball":
        radius = moved.norm(dim=2).amax(dim=1)[:, None, None]
        moved = moved / torch.where(radius > 0, radius, 1)
    return moved
