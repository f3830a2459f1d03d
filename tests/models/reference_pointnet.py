"""PointNet the straight way, as SimpleView has it: 1x1 convolutions on [B, C, N], norm, maximum."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.models.base import PointClassifier
from qs3.models.pointnet import PointMLP, TNet


def _mlp(mlp: PointMLP, x: Tensor) -> Tensor:
    """[b, c, n] to [b, d, n]."""
    for layer in mlp.layers:
        linear = isinstance(layer, nn.Linear)
        x = F.conv1d(x, layer.weight[:, :, None], layer.bias) if linear else layer(x)
    return x


def _tnet(tnet: TNet, x: Tensor) -> Tensor:
    """[b, c, n] to [b, c, c]."""
    flat = tnet.cloud(_mlp(tnet.points, x).max(2)[0])
    return flat.view(-1, tnet.channels, tnet.channels) + torch.eye(
        tnet.channels, dtype=x.dtype, device=x.device
    )


class NaivePointNet(nn.Module):
    """The whole classifier of `variant="simpleview"` with the parameters of `twin`, copied."""

    def __init__(self, twin: PointClassifier) -> None:
        super().__init__()
        twin = copy.deepcopy(twin)
        self.net, self.head = twin.backbone, twin.head

    def forward(self, points: Tensor) -> Tensor:
        net, x = self.net, points.transpose(1, 2)  # [b, 3, n]
        x = torch.bmm(x.transpose(1, 2), _tnet(net.input_transform, x)).transpose(1, 2)
        x = _mlp(net.first[0], x)
        x = torch.bmm(x.transpose(1, 2), _tnet(net.feature_transform, x)).transpose(1, 2)
        return self.head(_mlp(net.last, _mlp(net.middle[0], x)).max(2)[0])
