"""PointNet (Qi et al., CVPR 2017) with both T-Nets, as SimpleView compares with.

3,463,763 parameters for 10 classes. As there, the head has one dropout, before the norm of its
second layer, and a loss adds 0.001 times `Features.regulariser`.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.base import Backbone, Features, PointClassifier


class PointMLP(nn.Module):
    """Linear - BN - ReLU on each point of [B, N, C]; `last_relu=False` leaves out the last ReLU."""

    def __init__(self, *widths: int, last_relu: bool = True) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for wide, narrow in pairwise(widths):
            layers += [nn.Linear(wide, narrow), nn.BatchNorm1d(narrow), nn.ReLU()]
        self.layers = nn.Sequential(*layers[: None if last_relu else -1])

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n d"]:
        """The same map at every point, statistics over all points of the batch."""
        return self.layers(x.flatten(0, 1)).unflatten(0, x.shape[:2])


class TNet(nn.Module):
    """A matrix for each cloud, the identity plus what the cloud asks for: [B, C, C]."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.points = PointMLP(channels, 64, 128, 1024)
        self.cloud = nn.Sequential(
            *(nn.Linear(1024, 512), nn.BatchNorm1d(512), nn.ReLU()),
            *(nn.Linear(512, 256), nn.BatchNorm1d(256), nn.ReLU()),
            nn.Linear(256, channels**2),
        )

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b c c"]:
        """The matrix that multiplies row vectors from the right."""
        flat = self.cloud(self.points(x).amax(1))  # [b, c * c]
        identity = torch.eye(self.channels, dtype=x.dtype, device=x.device)
        return flat.view(-1, self.channels, self.channels) + identity


class PointNet(Backbone):
    """Input T-Net, 64, feature T-Net, 128, 1024, maximum."""

    feature_dim = 1024

    def __init__(self) -> None:
        super().__init__()
        self.input_transform = TNet(3)
        self.first = PointMLP(3, 64)
        self.feature_transform = TNet(64)
        self.last = PointMLP(64, 128, 1024, last_relu=False)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Maximum over the points; per point the 64 transformed features."""
        x = self.first(points @ self.input_transform(points))
        transform = self.feature_transform(x)  # [b, 64, 64]
        x = x @ transform
        return Features(self.last(x).amax(1), x, transform_regulariser(transform))


def transform_regulariser(transform: Float[Tensor, "b c c"]) -> Float[Tensor, ""]:
    """Mean of |I - A A'|_F (eq. 2 of the paper has its square; SimpleView and fxia22 do not)."""
    identity = torch.eye(transform.shape[1], dtype=transform.dtype, device=transform.device)
    return (identity - transform @ transform.transpose(1, 2)).flatten(1).norm(dim=1).mean()


def pointnet(num_classes: int, dropout: float = 0.3) -> PointClassifier:
    """PointNet with its class head (512, 256)."""
    head = nn.Sequential(
        *(nn.Linear(1024, 512), nn.BatchNorm1d(512), nn.ReLU()),
        *(nn.Linear(512, 256), nn.Dropout(dropout), nn.BatchNorm1d(256), nn.ReLU()),
        nn.Linear(256, num_classes),
    )
    return PointClassifier(PointNet(), head)
