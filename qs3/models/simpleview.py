"""SimpleView (Goyal et al., "Revisiting Point Cloud Shape Classification", ICML 2021).

Depth images of six sides (`qs3.models.projection`), one small ResNet for all of them
(`qs3.models.resnet`), and a head that sees the six features side by side. 800,122 parameters for
10 classes: 699,888 of the images' network and 100,234 of the head.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from qs3.config.checks import check_int
from qs3.errors import ConfigError
from qs3.kernels.norms import head_norm, make_norm
from qs3.models.base import Backbone, Features, PointClassifier
from qs3.models.projection import VIEWS, depth_images
from qs3.models.resnet import ResNet18


class SimpleView(Backbone):
    """Features of each depth image, side by side; a point has none of its own.

    Args:
        image_size: rows and columns of an image.
        views, up, pixel: of `depth_images`; `views` are rows of its table, in the order in which
            the head sees them.
        channels: at the stem of the network; a view has 8 times as many features.
        norm: see `qs3.kernels.norms`; "instance" is over each image.
    """

    def __init__(
        self,
        *,
        image_size: int = 128,
        views: Sequence[int] = tuple(range(VIEWS)),
        up: str = "y",
        pixel: str = "harmonic",
        channels: int = 16,
        norm: str = "batch",
    ) -> None:
        super().__init__()
        self.views = tuple(views)
        smallest = 9 if norm == "instance" else 8  # one pixel has no statistics
        check_int(f"model.image_size (with norm={norm})", image_size, smallest)
        check_int("model.channels", channels, 1)
        if not self.views or not set(self.views) <= set(range(VIEWS)):
            raise ConfigError(f"views must be some of 0 to {VIEWS - 1}, got {list(views)}")
        if up not in ("y", "z"):
            raise ConfigError(f"up must be 'y' or 'z', got {up!r}")
        if pixel not in ("harmonic", "nearest"):
            raise ConfigError(f"pixel must be 'harmonic' or 'nearest', got {pixel!r}")
        self.image_size, self.up, self.pixel = image_size, up, pixel
        self.images = ResNet18(channels, norm)
        self.feature_dim = len(self.views) * self.images.feature_dim

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to [B, V * 128], view after view."""
        images = depth_images(
            points, self.image_size, views=self.views, up=self.up, pixel=self.pixel
        )
        images = images.to(self.images.stem.conv.weight.dtype)  # of weights in half precision
        features = self.images(images.flatten(0, 1)[:, None])  # [b * v, 128] of [b * v, 1, h, w]
        return Features(features.view(points.shape[0], -1), None)


class FusionHead(nn.Module):
    """Norm and dropout of each view's features, then Linear - BN - ReLU - dropout - Linear.

    The first norm is shared by the views and its statistics are over all of them. What `norm` of
    the backbone means here: `qs3.kernels.norms.head_norm`.
    """

    def __init__(
        self,
        views: int,
        view_dim: int,
        num_classes: int,
        *,
        dropout: float = 0.5,
        norm: str = "batch",
    ) -> None:
        super().__init__()
        kind = head_norm(norm)
        self.view_dim = view_dim
        self.view_norm = make_norm(kind, view_dim)
        self.layers = nn.Sequential(
            nn.Dropout(dropout),
            nn.Linear(views * view_dim, view_dim),
            make_norm(kind, view_dim),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(view_dim, num_classes),
        )

    def forward(self, features: Float[Tensor, "b d"]) -> Float[Tensor, "b c"]:
        """Logits of [B, V * view_dim]."""
        views = self.view_norm(features.reshape(-1, self.view_dim))  # [b * v, view_dim]
        return self.layers(views.view(features.shape))


def simpleview(
    num_classes: int,
    image_size: int = 128,
    views: Sequence[int] = tuple(range(VIEWS)),
    up: str = "y",
    pixel: str = "harmonic",
    channels: int = 16,
    norm: str = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """SimpleView with its fusion head."""
    backbone = SimpleView(
        image_size=image_size, views=views, up=up, pixel=pixel, channels=channels, norm=norm
    )
    head = FusionHead(
        len(backbone.views), backbone.images.feature_dim, num_classes, dropout=dropout, norm=norm
    )
    return PointClassifier(backbone, head)
