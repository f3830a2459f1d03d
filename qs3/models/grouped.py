"""Shared MLPs on groups of neighbours, with the maximum over each group (PointNet++, 2017).

How it is computed is in `grouped_maximum`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.models.fast.grouped_mlp_max import grouped_maximum
from qs3.models.norms import active, make_norm, track, uses_batch


class GroupedMLP(nn.Module):
    """Convolution - norm - ReLU for each width, on the members of each group, then the maximum.

    Args:
        channels: C of the points' features, 0 if they have none.
        widths: of the layers, at least two.
        norm: see `qs3.models.norms`; statistics are of all members of all groups, of the batch or
            ("instance") of each cloud.
    """

    def __init__(self, channels: int, widths: Sequence[int], *, norm: str = "batch") -> None:
        super().__init__()
        sizes = (3 + channels, *widths)
        self.norm = norm
        self.linears = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in pairwise(sizes))
        self.norms = nn.ModuleList(make_norm(norm, width) for width in widths)
        for linear in self.linears:
            assert isinstance(linear, nn.Linear)
            nn.init.kaiming_normal_(linear.weight)

    def forward(
        self,
        xyz: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        centres: Float[Tensor, "b m 3"],
        index: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """The maximum over each group of the mapped (x_j - c_i, f_j), in float32 at least."""
        with torch.autocast(xyz.device.type, enabled=False):
            return self._forward(xyz, features, centres, index)

    def _forward(
        self, xyz: Tensor, features: Tensor | None, centres: Tensor, index: Tensor
    ) -> Tensor:
        weight: Tensor = self.linears[0].weight  # type: ignore[assignment]
        xyz, centres = xyz.to(weight.dtype), centres.to(weight.dtype)
        p = None if features is None else features.to(weight.dtype) @ weight[:, 3:].T
        if self.norm == "instance":
            parts = zip(xyz, centres, [None] * len(xyz) if p is None else p, index, strict=True)
            return torch.stack([self._groups(*cloud) for cloud in parts])
        first = torch.arange(len(xyz), device=xyz.device)[:, None, None] * xyz.shape[1]
        out = self._groups(
            xyz.flatten(0, 1),
            centres.flatten(0, 1),
            None if p is None else p.flatten(0, 1),
            (index + first).flatten(0, 1),
        )
        return out.unflatten(0, centres.shape[:2])

    def _groups(self, xyz: Tensor, centres: Tensor, p: Tensor | None, index: Tensor) -> Tensor:
        norms: list[Any] = [active(norm) for norm in self.norms]
        weights: list[Any] = [linear.weight for linear in self.linears]
        weights[0] = weights[0][:, :3]
        parameters = []
        for weight, norm in zip(weights, norms, strict=True):
            parameters += [weight, norm.weight, norm.bias]
        running = [
            None if uses_batch(norm) else (norm.running_mean, norm.running_var) for norm in norms
        ]
        out, statistics = grouped_maximum(
            xyz, centres, p, index, norms[0].eps, running, *parameters
        )
        for norm, (mean, var) in zip(self.norms, statistics, strict=True):
            track(norm, mean, var, index.numel())
        return out
