"""RS-CNN the straight way: every slot of every ball in memory, convolutions on [B, C, M, K]."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels.norms import active
from qs3.models.base import PointClassifier
from qs3.models.rscnn import LEVELS, RSConv, group


def _conv(x: Tensor, layer: nn.Linear) -> Tensor:
    """1x1 convolution of [b, c, ...]."""
    weight = layer.weight.view(*layer.weight.shape, *[1] * (x.ndim - 2))
    return (F.conv2d if x.ndim == 4 else F.conv1d)(x, weight, layer.bias)


def _norm(norm: nn.Module, x: Tensor) -> Tensor:
    """Batch norm of [b, c, ...]; norms without running statistics are norms of each cloud."""
    norm = active(norm)
    if norm.running_mean is None:
        return F.instance_norm(x, weight=norm.weight, bias=norm.bias, eps=norm.eps)
    if norm.training:
        norm.num_batches_tracked.add_(1)
    return F.batch_norm(
        x, norm.running_mean, norm.running_var, norm.weight, norm.bias, norm.training,
        norm.momentum, norm.eps,
    )  # fmt: skip


def rsconv_reference(
    layer: RSConv, xyz: Tensor, centres: Tensor, features: Tensor | None, index: Tensor, rule: str
) -> Tensor:
    """xyz [b, n, 3], features [b, c, n], index [b, m, k] to [b, d, m]."""
    absolute = gather(xyz, index).permute(0, 3, 1, 2)  # [b, 3, m, k]
    centre = centres.transpose(1, 2)[:, :, :, None].expand_as(absolute)
    d = absolute - centre
    length = d.norm(dim=1, keepdim=True)
    if rule == "paper":
        h = torch.cat([length, centre, absolute, d], dim=1)
    else:  # the in-place subtraction made "absolute" d, and xi is taken from slot 0 of it
        h = torch.cat([length, d[:, :, :, :1].expand_as(d), d, d], dim=1)
    w = _conv(F.relu(_norm(layer.mapping_norm, _conv(h, layer.mapping))), layer.weighing)
    if features is None:
        x = F.relu(_norm(layer.raising_norm, _conv(d, layer.raising)))
    else:
        x = torch.cat([d, gather(features.transpose(1, 2), index).permute(0, 3, 1, 2)], dim=1)
    p = F.relu(_norm(layer.norm, w * x))
    best = F.max_pool2d(p, (1, p.shape[3])).squeeze(3)
    return F.relu(_norm(layer.channel_norm, _conv(best, layer.channel_raising)))


class NaiveRSCNN(nn.Module):
    """The whole classifier with the parameters of `twin`, copied; the same neighbours."""

    def __init__(self, twin: PointClassifier) -> None:
        super().__init__()
        twin = copy.deepcopy(twin)
        self.net, self.head = twin.backbone, twin.head

    def forward(self, points: Tensor) -> Tensor:
        net, features = self.net, None
        for layer, (count, radius, slots) in zip(net.layers, LEVELS, strict=True):
            start = farthest_point_sampling(points, count)
            centres = gather(points, start)
            index = group(points, centres, start, radius, slots, net.relation)
            features = rsconv_reference(layer, points, centres, features, index, net.relation)
            points = centres
        x = torch.cat([points.transpose(1, 2), features], dim=1)  # [b, 515, 128]
        x = F.relu(_norm(net.last_norm, _conv(x[:, :, None], net.last)))
        return self.head(F.max_pool2d(x, (1, x.shape[3])).flatten(1))
