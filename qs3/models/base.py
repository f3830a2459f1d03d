"""What all backbones share: features of a cloud, and a head that turns them into logits."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import DataError
from qs3.kernels.device import exporting
from qs3.kernels.norms import Norm, head_norm, make_norm


class Features(NamedTuple):
    """A backbone's features of a batch of clouds."""

    global_: Float[Tensor, "b d"]  # D = `Backbone.feature_dim`
    per_point: Float[Tensor, "b n c"] | None  # None where a backbone has none
    regulariser: Float[Tensor, ""] | None = None  # that PointNet wants in the loss, unweighted


class Backbone(nn.Module):
    """Clouds [B, N, 3] to `Features`; subclasses set `feature_dim`.

    Attributes:
        feature_dim: D of `Features.global_`.
        least_points: with how many points at least it does the same whatever their number; a net
            exported for as many takes clouds of any number from there on.
    """

    feature_dim: int
    least_points: int = 1

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Features of each cloud; the order of its points does not matter."""
        raise NotImplementedError


class ClassHead(nn.Sequential):
    """Linear - BN - activation - dropout per hidden layer, and a last Linear.

    Args:
        feature_dim: D of the backbone.
        num_classes: C.
        hidden: widths between, each with `dropout` behind.
        negative_slope: of LeakyReLU; 0 is ReLU.
        first_bias, hidden_bias: False where the first, or no, hidden layer has one as published.
        norm: of the backbone; see `qs3.kernels.norms.head_norm` for what it is here.
    """

    def __init__(
        self,
        feature_dim: int,
        num_classes: int,
        *,
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
        negative_slope: float = 0.2,
        first_bias: bool = True,
        hidden_bias: bool = True,
        norm: Norm = "batch",
    ) -> None:
        widths = (feature_dim, *hidden)
        layers: list[nn.Module] = []
        for i, (wide, narrow) in enumerate(zip(widths, hidden, strict=False)):
            layers += [
                nn.Linear(wide, narrow, bias=hidden_bias and (first_bias or i > 0)),
                make_norm(head_norm(norm), narrow),
                nn.LeakyReLU(negative_slope),
                nn.Dropout(dropout),
            ]
        super().__init__(*layers, nn.Linear(widths[-1], num_classes))


class PointClassifier(nn.Module):
    """A backbone and a head.

    In train mode the head's batch norm needs two clouds at least; in eval one is enough.
    """

    def __init__(self, backbone: Backbone, head: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone
        self.head = head

    def features(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Features of checked clouds: for heads besides the classifier's."""
        check_points(points)
        return self.backbone(points)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits."""
        return self.head(self.features(points).global_)


def with_head(backbone: Backbone, num_classes: int, **settings: Any) -> PointClassifier:
    """A backbone and a `ClassHead` with these settings."""
    return PointClassifier(backbone, ClassHead(backbone.feature_dim, num_classes, **settings))


def check_points(points: Tensor) -> None:
    """Raise `DataError` unless `points` is a finite, not empty [B, N, 3].

    A training step on a device would wait for the answer in each of its passes, so there values
    are looked at on the CPU and in evaluation alone: what is trained on was checked by the store.
    An exported net does not look at them.
    """
    if points.ndim != 3 or points.shape[2] != 3 or points.shape[0] == 0 or points.shape[1] == 0:
        raise DataError(f"expected points [B >= 1, N >= 1, 3], got {list(points.shape)}")
    if exporting() or (points.device.type != "cpu" and torch.is_grad_enabled()):
        return
    finite = torch.isfinite(points)
    if not finite.all():
        item = int((~finite).flatten(1).any(1).nonzero()[0, 0])
        raise DataError(f"coordinates of batch item {item} are NaN or infinite")
