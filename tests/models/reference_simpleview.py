"""SimpleView the straight way: the released sequence of operations, plain layers.

The released code adds the images' channel as a last axis and moves it to the front. Such strides
make torch choose channels-last layout from the first convolution on, and so they do here.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.models.base import PointClassifier

QUARTER = torch.pi / 2
EULER = [
    (0, 0, QUARTER), (QUARTER, 0, QUARTER), (2 * QUARTER, 0, QUARTER),
    (3 * QUARTER, 0, QUARTER), (0, -QUARTER, QUARTER), (0, QUARTER, QUARTER),
]  # fmt: skip


def rotation(a: float, b: float, c: float) -> Tensor:
    """Rx(a) Ry(b) Rz(c), float64."""
    out = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate((a, b, c)):
        i, j = [k for k in range(3) if k != axis]
        one = torch.eye(3, dtype=torch.float64)
        cos, sin = torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle))
        one[i, i], one[j, j], one[i, j], one[j, i] = cos, cos, -sin, sin
        if axis == 1:
            one = one.T
        out = out @ one
    return out


def images_reference(points: Tensor, size: int = 128) -> Tensor:
    """[b, n, 3] to [6 b, size, size]: each view's cloud turned, all pixels scattered, divided."""
    turn = torch.stack([rotation(*angles) for angles in EULER])
    # cosines of right angles are not quite 0: which side of a pixel's rim a point falls on would
    # depend on it
    turn = turn.round().to(points)
    b = len(points)
    views = len(turn)
    clouds = points.repeat_interleave(views, dim=0) @ turn.repeat(b, 1, 1).transpose(1, 2)
    clouds = clouds - torch.tensor([0, 0, -1.4], dtype=points.dtype, device=points.device)
    depth = clouds[:, :, 2]
    row = ((clouds[:, :, 0] / (depth + 1e-12) + 1) * size / 2 - 0.5).ceil()
    column = ((clouds[:, :, 1] / (depth + 1e-12) + 1) * size / 2 - 0.5).ceil()
    seen = (row >= 0) & (row <= size - 1) & (column >= 0) & (column <= size - 1) & (depth >= 0)
    weight = seen.to(depth) * (1 / (depth + 1e-12))
    where = ((row % size) * size + column % size).long()
    empty = torch.zeros(b * views, size * size).to(points)
    weights = empty.scatter_add(1, where, weight)
    values = empty.scatter_add(1, where, depth * weight)
    weights = weights + (weights == 0).to(weights)
    return (values / weights).view(-1, size, size)


class NaiveSimpleView(nn.Module):
    """The whole classifier with the parameters of `twin`, copied."""

    def __init__(self, twin: PointClassifier) -> None:
        super().__init__()
        twin = copy.deepcopy(twin).to(memory_format=torch.contiguous_format)
        self.size = twin.backbone.image_size
        self.images, self.head = twin.backbone.images, twin.head

    def forward(self, points: Tensor) -> Tensor:
        image = images_reference(points.detach(), self.size)
        stem = self.images.stem
        x = F.relu(stem.norm(stem.conv(image.unsqueeze(3).permute(0, 3, 1, 2))), inplace=True)
        for block in self.images.blocks:
            first, second, short = block.first, block.second, block.shortcut
            y = F.relu(first.norm(first.conv(x)), inplace=True)
            y = second.norm(second.conv(y))
            if short is not None:
                x = short.norm(F.conv2d(x, short.conv.weight, stride=first.conv.stride))
            y += x
            x = F.relu(y, inplace=True)
        features = F.adaptive_avg_pool2d(x, 1)
        return self.head(features.view(len(points), -1))
