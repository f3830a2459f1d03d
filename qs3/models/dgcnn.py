"""DGCNN (Wang et al., "Dynamic Graph CNN for Learning on Point Clouds", TOG 2019).

Three variants, chosen by `variant`; parameters are with the class head for 10 classes:
- "uda": what QS3 trains: no T-Net, conv5 without norm and activation, maximum and mean, biases in
  the whole head. 1,800,330 parameters.
- "simpleview": the authors' classification net, as in SimpleView's comparison: conv5 with batch
  norm and LeakyReLU, no bias in the head's first layer. 1,801,866 parameters.
- "defrec": of DefRec (Achituve et al., WACV 2021): a T-Net on the edges of the input, conv5 as in
  "simpleview", the maximum alone, biases in the whole head. 2,079,635 parameters.
"""

from typing import Annotated, Literal

import torch
from annotated_types import Ge
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3 import kernels as fast
from qs3.geometry.neighbours import gather, knn
from qs3.kernels.device import exact_products, takes_triton
from qs3.kernels.edgeconv import edge_conv
from qs3.kernels.linear_max import pooled_linear
from qs3.kernels.matmul import linear
from qs3.kernels.norms import Norm, head_norm, make_norm, normed, uses_batch
from qs3.kernels.pointwise_max import max_over_members, max_over_rows
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.utils.settings import checked

Variant = Literal["uda", "simpleview", "defrec"]
SLOPE = 0.2  # of LeakyReLU


class EdgeConv(nn.Module):
    """Equation 8: max_j LeakyReLU(norm(W (x_j - x_i, x_i))) over the neighbours j of a point i.

    [B, N, Cin] and neighbours [B, N, k] to [B, N, Cout].

    Args:
        in_channels, out_channels: Cin, Cout.
        norm: see `qs3.kernels.norms`; "batch" is over all edges of the batch, "instance" over the
            edges of each cloud, in eval too.
    """

    def __init__(self, in_channels: int, out_channels: int, *, norm: Norm = "batch") -> None:
        super().__init__()
        self.linear = nn.Linear(2 * in_channels, out_channels, bias=False)
        self.norm = make_norm(norm, out_channels)

    def forward(
        self, x: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "b n d"]:
        """The layer's output; edges are in float32 under autocast as well."""
        weight = self.linear.weight
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(weight.dtype)
            if fast.usable(x, anywhere=True, traceable=not uses_batch(self.norm)):
                return edge_conv(x, index, weight, self.norm, SLOPE)
            z = normed(self.norm, self.linear(edges_of(x, index)))  # [b, n, k, d]
            return max_over_members(F.leaky_relu(z, SLOPE))


def edges_of(x: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]) -> Float[Tensor, "b n k 2*c"]:
    """Edges (x_j - x_i, x_i) from each point i to its neighbours j."""
    neighbour = gather(x, index)  # [b, n, k, c]
    centre = x[:, :, None].expand_as(neighbour)
    return torch.cat([neighbour - centre, centre], dim=3)


class EdgeTNet(nn.Module):
    """DefRec's T-Net: from the edges of a cloud the identity plus what they ask for, [B, 3, 3].

    Two layers act on each edge, so unlike EdgeConv's they cannot be computed without edges.
    """

    def __init__(self, norm: Norm = "batch") -> None:
        super().__init__()
        kind = head_norm(norm)  # rows of all clouds together

        def layer(wide: int, narrow: int, bias: bool = False) -> list[nn.Module]:
            linear = nn.Linear(wide, narrow, bias=bias)
            return [linear, make_norm(kind, narrow), nn.LeakyReLU(SLOPE)]

        self.edges = nn.Sequential(*layer(6, 64), *layer(64, 128))
        self.points = nn.Sequential(*layer(128, 1024))
        self.cloud = nn.Sequential(
            *layer(1024, 512), *layer(512, 256, bias=True), nn.Linear(256, 9)
        )

    def forward(self, points: Float[Tensor, "b n 3"], k: int) -> Float[Tensor, "b 3 3"]:
        """The matrix that multiplies column vectors from the left."""
        b, n, _ = points.shape
        edges = edges_of(points, knn(points, k))  # [b, n, k, 6]
        x = self.edges(edges.flatten(0, 2)).view(b * n, k, -1).amax(1)
        x = self.points(x).view(b, n, -1).amax(1)
        return self.cloud(x).view(b, 3, 3) + torch.eye(3, dtype=x.dtype, device=x.device)


class DGCNN(Backbone):
    """Four EdgeConvs whose neighbours are found anew in feature space, then pooled.

    Args:
        k: neighbours of a point, itself included; clouds smaller than k use all points.
        variant: "uda", "simpleview" or "defrec", see the module.
        norm: of the EdgeConvs and of conv5, see `qs3.kernels.norms`; the T-Net of "defrec" has
            batch norm where this is "instance".
        widths: channels of the EdgeConvs.
        embedding: channels of conv5; `feature_dim` is twice that where maximum and mean are taken.
    """

    def __init__(
        self,
        *,
        k: int = 20,
        variant: Variant = "uda",
        norm: Norm = "batch",
        widths: tuple[int, ...] = (64, 64, 128, 256),
        embedding: int = 1024,
    ) -> None:
        super().__init__()
        self.k = self.least_points = k
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
        n = points.shape[1]
        k = n if n < self.k else self.k  # a number in an export too; min() would be a symbol
        x, levels = points, []
        if self.transform is not None:
            transform = self.transform(points, k)  # [b, 3, 3]
            with exact_products():  # as in PointNet
                x = points @ transform.transpose(1, 2)
        for layer in self.edge_convs:
            x = layer(x, knn(x, k))
            levels.append(x)
        per_point = torch.cat(levels, dim=2)  # [B, N, 512]
        if self.norm5 is None and fast.usable(x, anywhere=takes_triton(x)):
            return Features(pooled_linear(per_point, self.conv5.weight), per_point)
        y = linear(per_point, self.conv5.weight)  # [B, N, 1024]
        if self.norm5 is not None:
            y = F.leaky_relu(normed(self.norm5, y), SLOPE)
        most, _ = max_over_rows(y) if fast.usable(x) else y.max(1)
        if self.variant == "defrec":
            return Features(most, per_point)
        return Features(torch.cat([most, y.mean(1)], dim=1), per_point)


@checked
def dgcnn(
    num_classes: int,
    k: Annotated[int, Ge(1)] = 20,
    variant: Variant = "uda",
    norm: Norm = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """DGCNN with its class head (512, 256; batch norm, LeakyReLU 0.2)."""
    backbone = DGCNN(k=k, variant=variant, norm=norm)
    first_bias = variant != "simpleview"
    return with_head(backbone, num_classes, dropout=dropout, first_bias=first_bias, norm=norm)
