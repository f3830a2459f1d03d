"""DGCNN (Wang et al., "Dynamic Graph CNN for Learning on Point Clouds", TOG 2019).

Three variants, chosen by `variant`; parameters are with the class head for 10 classes:
- "uda": what QS3 trains: no T-Net, conv5 without norm and activation, maximum and mean, biases in
  the whole head. 1,800,330 parameters.
- "simpleview": the authors' classification net, as in SimpleView's comparison: conv5 with batch
  norm and LeakyReLU, no bias in the head's first layer. 1,801,866 parameters.
- "defrec": of DefRec (Achituve et al., WACV 2021): a T-Net on the edges of the input, conv5 as in
  "simpleview", the maximum alone, biases in the whole head. 2,079,635 parameters.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.geometry.matmul import linear, times
from qs3.geometry.neighbours import gather, knn
from qs3.models.base import Backbone, ClassHead, Features, PointClassifier
from qs3.models.fast.edgeconv import EdgeConv, max_over_rows
from qs3.models.norms import head_norm, make_norm

VARIANTS = ("uda", "simpleview", "defrec")


class EdgeTNet(nn.Module):
    """DefRec's T-Net: from the edges of a cloud the identity plus what they ask for, [B, 3, 3].

    Two layers act on each edge, so unlike EdgeConv's they cannot be computed without edges.
    """

    def __init__(self, norm: str = "batch") -> None:
        super().__init__()
        kind = head_norm(norm)  # rows of all clouds together

        def layer(wide: int, narrow: int, bias: bool = False) -> list[nn.Module]:
            linear = nn.Linear(wide, narrow, bias=bias)
            return [linear, make_norm(kind, narrow), nn.LeakyReLU(0.2)]

        self.edges = nn.Sequential(*layer(6, 64), *layer(64, 128))
        self.points = nn.Sequential(*layer(128, 1024))
        self.cloud = nn.Sequential(
            *layer(1024, 512), *layer(512, 256, bias=True), nn.Linear(256, 9)
        )

    def forward(self, points: Float[Tensor, "b n 3"], k: int) -> Float[Tensor, "b 3 3"]:
        """The matrix that multiplies column vectors from the left."""
        b, n, _ = points.shape
        neighbour = gather(points, knn(points, k))  # [b, n, k, 3]
        centre = points[:, :, None].expand_as(neighbour)
        edges = torch.cat([neighbour - centre, centre], dim=3)
        x = self.edges(edges.flatten(0, 2)).view(b * n, k, -1).amax(1)
        x = self.points(x).view(b, n, -1).amax(1)
        return self.cloud(x).view(b, 3, 3) + torch.eye(3, dtype=x.dtype, device=x.device)


class DGCNN(Backbone):
    """Four EdgeConvs whose neighbours are found anew in feature space, then pooled.

    Args:
        k: neighbours of a point, itself included; clouds smaller than k use all points.
        variant: "uda", "simpleview" or "defrec", see the module.
        norm: of the EdgeConvs and of conv5, see `qs3.models.norms`; "defrec"'s T-Net has batch norm
            where this is "instance".
        widths: channels of the EdgeConvs.
        embedding: channels of conv5; `feature_dim` is twice that where maximum and mean are taken.
    """

    def __init__(
        self,
        *,
        k: int = 20,
        variant: str = "uda",
        norm: str = "batch",
        widths: tuple[int, ...] = (64, 64, 128, 256),
        embedding: int = 1024,
    ) -> None:
        super().__init__()
        if variant not in VARIANTS:
            names = ", ".join(f"'{v}'" for v in VARIANTS)
            raise ConfigError(f"variant must be one of {names}, got {variant!r}")
        if k < 1:
            raise ConfigError(f"k must be at least 1, got {k}")
        self.k = k
        self.variant = variant
        self.feature_dim = embedding if variant == "defrec" else 2 * embedding
        self.transform = EdgeTNet(norm) if variant == "defrec" else None
        self.edge_convs = nn.ModuleList(
            EdgeConv(c, d, norm=norm) for c, d in zip((3, *widths), widths, strict=False)
        )
        self.conv5 = nn.Linear(sum(widths), embedding, bias=False)
        self.norm5 = None if variant == "uda" else make_norm(norm, embedding)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to the pooled conv5, and the EdgeConvs' outputs per point."""
        k = min(self.k, points.shape[1])
        x, levels = points, []
        if self.transform is not None:
            x = points @ self.transform(points, k).transpose(1, 2)
        for edge_conv in self.edge_convs:
            x = edge_conv(x, knn(x, k))
            levels.append(x)
        per_point = torch.cat(levels, dim=2)  # [B, N, 512]
        if self.norm5 is None:
            return Features(pooled_linear(per_point, self.conv5.weight), per_point)
        y = F.leaky_relu(self._normed(linear(per_point, self.conv5.weight)), 0.2)  # [B, N, 1024]
        most, _ = max_over_rows(y)
        if self.variant == "defrec":
            return Features(most, per_point)
        return Features(torch.cat([most, y.mean(1)], dim=1), per_point)

    def _normed(self, y: Tensor) -> Tensor:
        """norm5 of [B, N, D], as rows where it can be: twice as fast as in [B, D, N]."""
        assert self.norm5 is not None
        if isinstance(self.norm5, nn.InstanceNorm1d):
            return self.norm5(y.transpose(1, 2)).transpose(1, 2)
        return self.norm5(y.flatten(0, 1)).view_as(y)


class _PooledLinear(torch.autograd.Function):
    """Its gradient needs no [B, N, D]: the maximum's is one row of x and of weight per channel."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        b, n, _ = x.shape
        d = weight.shape[0]
        out = x.new_empty(b, 2 * d)
        where = torch.empty(b, d, dtype=torch.int64, device=x.device)
        step = max(1, (1 << 22) // (n * d))  # 16 MB of float32
        for i in range(0, b, step):
            y = times(x[i : i + step], weight)  # [step, n, d]
            out[i : i + step, :d], where[i : i + step] = max_over_rows(y)
        centre = x.mean(1)  # [b, c]
        torch.mm(centre, weight.T, out=out[:, d:])
        ctx.save_for_backward(x, weight, where, centre)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        x, weight, where, centre = ctx.saved_tensors
        most, mean = grad.chunk(2, dim=1)  # [b, d] each
        dx = (mean @ weight / x.shape[1])[:, None].expand_as(x).contiguous()
        dweight = mean.T @ centre
        for x_i, dx_i, most_i, where_i in zip(x, dx, most[:, :, None], where, strict=True):
            dx_i.index_add_(0, where_i, most_i * weight)
            dweight.addcmul_(most_i, x_i.index_select(0, where_i))
        return dx, dweight


def pooled_linear(
    x: Float[Tensor, "b n c"], weight: Float[Tensor, "d c"]
) -> Float[Tensor, "b 2*d"]:
    """Maximum and mean over the points of a linear map without bias."""
    return _PooledLinear.apply(x, weight)


def dgcnn(
    num_classes: int,
    k: int = 20,
    variant: str = "uda",
    norm: str = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """DGCNN with its class head (512, 256; batch norm, LeakyReLU 0.2)."""
    backbone = DGCNN(k=k, variant=variant, norm=norm)
    head = ClassHead(
        backbone.feature_dim,
        num_classes,
        dropout=dropout,
        first_bias=variant != "simpleview",
        norm=norm,
    )
    return PointClassifier(backbone, head)
