"""DGCNN (Wang et al., "Dynamic Graph CNN for Learning on Point Clouds", TOG 2019).

Two variants, chosen by `variant`:
- "uda": what QS3, after DefRec and GAST, trains: no T-Net, conv5 without norm and activation,
  biases in the whole head. 1,800,330 parameters for 10 classes.
- "simpleview": the authors' classification net, as in SimpleView's comparison: conv5 with batch
  norm and LeakyReLU, no bias in the head's first layer. 1,801,866 parameters for 10 classes.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.geometry.neighbours import knn
from qs3.models.base import Backbone, ClassHead, Features, PointClassifier
from qs3.models.edgeconv import EdgeConv, max_over_rows


class DGCNN(Backbone):
    """Four EdgeConvs whose neighbours are found anew in feature space, then pooled.

    Args:
        k: neighbours of a point, itself included; clouds smaller than k use all points.
        variant: "uda" or "simpleview", see the module.
        norm: "batch" or "instance", of the EdgeConvs and of "simpleview"'s conv5.
        widths: channels of the EdgeConvs.
        embedding: channels of conv5; `feature_dim` is twice that (maximum and mean).
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
        if variant not in ("uda", "simpleview"):
            raise ConfigError(f"variant must be 'uda' or 'simpleview', got {variant!r}")
        if norm not in ("batch", "instance"):
            raise ConfigError(f"norm must be 'batch' or 'instance', got {norm!r}")
        if k < 1:
            raise ConfigError(f"k must be at least 1, got {k}")
        self.k = k
        self.variant = variant
        self.feature_dim = 2 * embedding
        self.edge_convs = nn.ModuleList(
            EdgeConv(c, d, norm=norm) for c, d in zip((3, *widths), widths, strict=False)
        )
        self.conv5 = nn.Linear(sum(widths), embedding, bias=False)
        norms = {
            "batch": nn.BatchNorm1d(embedding),
            "instance": nn.InstanceNorm1d(embedding, affine=True),
        }
        self.norm5 = norms[norm] if variant == "simpleview" else None

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to maximum and mean of conv5, and the EdgeConvs' outputs per point."""
        k = min(self.k, points.shape[1])
        x, levels = points, []
        for edge_conv in self.edge_convs:
            x = edge_conv(x, knn(x, k))
            levels.append(x)
        per_point = torch.cat(levels, dim=2)  # [B, N, 512]
        if self.norm5 is None:
            return Features(pooled_linear(per_point, self.conv5.weight), per_point)
        y = self.norm5(self.conv5(per_point).transpose(1, 2))  # [B, 1024, N]
        y = F.leaky_relu(y, 0.2)
        return Features(torch.cat([y.amax(2), y.mean(2)], dim=1), per_point)


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
            y = x[i : i + step] @ weight.T  # [step, n, d]
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
        backbone.feature_dim, num_classes, dropout=dropout, first_bias=variant == "uda"
    )
    return PointClassifier(backbone, head)
