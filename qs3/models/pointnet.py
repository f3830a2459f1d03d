"""PointNet (Qi et al., CVPR 2017).

Three variants, chosen by `variant`; parameters are with the class head for 10 classes:
- "simpleview": with both T-Nets, as SimpleView compares with. The last layer before the maximum has
  no ReLU, the head one dropout, before the norm of its second layer. SimpleView adds 0.001 times
  `Features.regulariser` to the loss. 3,463,763 parameters.
- "uda": that of the lineage from DefRec to QS3: one more layer of 64 on both sides of the second
  T-Net, ReLU everywhere, two dropouts in the head; no regulariser in the loss. 3,471,827.
- "basic": of DGCNN's repository, without T-Nets and with a head of one hidden layer. 680,778.
"""

from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3 import kernels as fast
from qs3.kernels.device import exact_products
from qs3.kernels.norms import Norm, head_norm, make_norm, normed
from qs3.kernels.pointwise_max import normed_maximum
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.utils.settings import checked

Variant = Literal["simpleview", "uda", "basic"]


class PointMLP(nn.Module):
    """Linear - norm - ReLU on each point of [B, N, C].

    Args:
        widths: C, and channels of each layer.
        last_relu: False leaves out the last ReLU.
        bias: of the linear maps.
        norm: see `qs3.kernels.norms`; "batch" is over all points of the batch.
    """

    def __init__(
        self, *widths: int, last_relu: bool = True, bias: bool = True, norm: Norm = "batch"
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for wide, narrow in pairwise(widths):
            layers += [nn.Linear(wide, narrow, bias=bias), make_norm(norm, narrow), nn.ReLU()]
        self.layers = nn.Sequential(*layers[: None if last_relu else -1])
        self.by_cloud = norm == "instance"

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n d"]:
        """The same map at every point."""
        for layer in self.layers:
            acts_on_values = isinstance(layer, nn.Linear | nn.ReLU)
            x = layer(x) if acts_on_values else normed(layer, x)
        return x

    def maximum(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b d"]:
        """`self(x).max(1)[0]`; on the CPU without the last layer's output at every point."""
        plain = self.by_cloud or torch.is_autocast_enabled("cpu") or not fast.usable(x)
        if plain or torch.compiler.is_compiling():
            return self(x).max(1)[0]
        last_relu = isinstance(self.layers[-1], nn.ReLU)
        layers = list(self.layers)[: -1 if last_relu else None]
        layer, norm = layers[-2:]
        y = x.flatten(0, 1)
        for module in layers[:-2]:
            y = module(y)
        assert isinstance(layer, nn.Linear)
        best = normed_maximum(y.unflatten(0, x.shape[:2]), layer, norm)
        return best.relu() if last_relu else best


class TNet(nn.Module):
    """A matrix for each cloud, the identity plus what the cloud asks for: [B, C, C].

    Args:
        channels: C.
        activation: after the maximum; PointDAN has LeakyReLU 0.01 there, the others ReLU.
    """

    def __init__(
        self, channels: int, norm: Norm = "batch", activation: type[nn.Module] = nn.ReLU
    ) -> None:
        super().__init__()
        self.channels = channels
        self.points = PointMLP(channels, 64, 128, 1024, norm=norm)
        kind = head_norm(norm)
        self.cloud = nn.Sequential(
            *(nn.Linear(1024, 512), make_norm(kind, 512), activation()),
            *(nn.Linear(512, 256), make_norm(kind, 256), activation()),
            nn.Linear(256, channels**2),
        )

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b c c"]:
        """The matrix that multiplies row vectors from the right."""
        flat = self.cloud(self.points.maximum(x))  # [b, c * c]
        identity = torch.eye(self.channels, dtype=x.dtype, device=x.device)
        return flat.view(-1, self.channels, self.channels) + identity


class PointNet(Backbone):
    """Shared maps of each point, and the maximum over the points; see the module for variants."""

    feature_dim = 1024

    def __init__(self, *, variant: Variant = "simpleview", norm: Norm = "batch") -> None:
        super().__init__()
        turned = variant != "basic"
        relu, bias = variant != "simpleview", variant != "basic"
        first, middle = {
            "simpleview": ([(3, 64)], [(64, 128)]),
            "uda": ([(3, 64), (64, 64)], [(64, 64), (64, 128)]),
            "basic": ([(3, 64), (64, 64)], [(64, 64), (64, 128)]),
        }[variant]

        def layers(widths: list[tuple[int, int]]) -> nn.ModuleList:
            return nn.ModuleList(PointMLP(*w, bias=bias, norm=norm) for w in widths)

        # in the order in which data passes them, which AdaBN goes by
        self.input_transform = TNet(3, norm) if turned else None
        self.first = layers(first)
        self.feature_transform = TNet(64, norm) if turned else None
        self.middle = layers(middle)
        self.last = PointMLP(128, 1024, last_relu=relu, bias=bias, norm=norm)
        self.every_level = variant != "simpleview"

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Maximum over the points; per point the first layers, as these variants publish it.

        Those are the 64 transformed features of "simpleview", and of the others the outputs of all
        layers but the last, [B, N, 320].
        """
        x, levels, regulariser = points, [], None
        if self.input_transform is not None:
            # bfloat16 has 8 bits for a coordinate, TF32 11: rounded ones would differ as clouds do
            with torch.autocast(points.device.type, enabled=False):
                transform = self.input_transform(x)
                with exact_products():
                    x = x @ transform
        for layer in self.first:
            x = layer(x)
            levels.append(x)
        if self.feature_transform is not None:
            transform = self.feature_transform(x)  # [b, 64, 64]
            regulariser = transform_regulariser(transform)
            x = x @ transform
        per_point = x
        for layer in self.middle:
            x = layer(x)
            levels.append(x)
        if self.every_level:
            per_point = torch.cat(levels, dim=2)
        return Features(self.last.maximum(x), per_point, regulariser)


def transform_regulariser(transform: Float[Tensor, "b c c"]) -> Float[Tensor, ""]:
    """Mean of |I - A A'|_F (eq. 2 of the paper has its square; SimpleView and fxia22 do not)."""
    identity = torch.eye(transform.shape[1], dtype=transform.dtype, device=transform.device)
    return (identity - transform @ transform.transpose(1, 2)).flatten(1).norm(dim=1).mean()


@checked
def pointnet(
    num_classes: int, dropout: float = 0.3, variant: Variant = "simpleview", norm: Norm = "batch"
) -> PointClassifier:
    """PointNet with its class head: hidden layers of 512 and 256, of 512 in "basic"."""
    backbone = PointNet(variant=variant, norm=norm)
    if variant == "simpleview":
        kind = head_norm(norm)
        head = nn.Sequential(
            *(nn.Linear(1024, 512), make_norm(kind, 512), nn.ReLU()),
            *(nn.Linear(512, 256), nn.Dropout(dropout), make_norm(kind, 256), nn.ReLU()),
            nn.Linear(256, num_classes),
        )
        return PointClassifier(backbone, head)
    return with_head(
        backbone,
        num_classes,
        hidden=(512,) if variant == "basic" else (512, 256),
        dropout=dropout,
        negative_slope=0.0,
        first_bias=False,
        norm=norm,
    )
