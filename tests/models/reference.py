"""Straight implementations to compare with: short, slow, with every edge in memory.

The operations and their order are those of DGCNN's authors, so that times compare.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.models.base import PointClassifier
from qs3.models.dgcnn import EdgeConv


def knn_reference(x: Tensor, k: int) -> Tensor:
    """As DGCNN's authors: the whole matrix and topk."""
    squares = x.square().sum(2)
    distance = squares[:, :, None] - 2 * x @ x.transpose(1, 2) + squares[:, None]
    return distance.topk(k, largest=False)[1]


def edge_conv_reference(
    x: Tensor, index: Tensor, weight: Tensor, norm: nn.Module, slope: float = 0.2
) -> Tensor:
    """1x1 convolution of (x_j - x_i, x_i), norm over [B, C, N, k], LeakyReLU, maximum over k."""
    b, n, c = x.shape
    k = index.shape[2]
    first = torch.arange(b, device=x.device).view(-1, 1, 1) * n
    neighbour = x.reshape(b * n, c)[(index + first).view(-1)].view(b, n, k, c)
    centre = x.view(b, n, 1, c).repeat(1, 1, k, 1)
    edges = torch.cat([neighbour - centre, centre], dim=3)
    edges = edges.permute(0, 3, 1, 2).contiguous()  # [b, 2c, n, k]
    z = F.conv2d(edges, weight[:, :, None, None])
    return F.leaky_relu(norm(z), slope).max(3)[0].transpose(1, 2).contiguous()


class NaiveEdgeConv(nn.Module):
    """`EdgeConv` with the same parameters, the straight way."""

    def __init__(self, twin: EdgeConv) -> None:
        super().__init__()
        d, _ = twin.linear.weight.shape
        self.weight = nn.Parameter(twin.linear.weight.detach().clone())
        self.bn: nn.Module
        if isinstance(twin.norm, nn.BatchNorm1d):
            self.bn = nn.BatchNorm2d(d).to(self.weight)
            self.bn.running_mean.copy_(twin.norm.running_mean)
            self.bn.running_var.copy_(twin.norm.running_var)
        else:
            self.bn = nn.InstanceNorm2d(d, affine=True).to(self.weight)
        with torch.no_grad():
            self.bn.weight.copy_(twin.norm.weight)
            self.bn.bias.copy_(twin.norm.bias)

    def forward(self, x: Tensor, index: Tensor) -> Tensor:
        return edge_conv_reference(x, index, self.weight, self.bn)


class NaiveDGCNN(nn.Module):
    """The whole classifier, the straight way; weights of `twin`."""

    def __init__(self, twin: PointClassifier) -> None:
        super().__init__()
        self.k = twin.backbone.k
        self.edge_convs = nn.ModuleList(NaiveEdgeConv(e) for e in twin.backbone.edge_convs)
        self.conv5, self.norm5, self.head = twin.backbone.conv5, twin.backbone.norm5, twin.head

    def forward(self, points: Tensor) -> Tensor:
        x, levels = points, []
        k = min(self.k, points.shape[1])
        for edge_conv in self.edge_convs:
            x = edge_conv(x, knn_reference(x.detach(), k))
            levels.append(x)
        y = torch.cat([level.transpose(1, 2) for level in levels], dim=1)  # [b, c, n]
        y = F.conv1d(y, self.conv5.weight[:, :, None])
        if self.norm5 is not None:
            y = F.leaky_relu(self.norm5(y), 0.2)
        pooled = F.adaptive_max_pool1d(y, 1), F.adaptive_avg_pool1d(y, 1)
        return self.head(torch.cat(pooled, dim=1).flatten(1))
