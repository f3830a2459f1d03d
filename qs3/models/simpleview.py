"""SimpleView (Goyal et al., "Revisiting Point Cloud Shape Classification", ICML 2021).

Depth images of six sides, one small ResNet for all of them, and a head that sees the six features
side by side. 800,122 parameters for 10 classes: 699,888 of the images' network and 100,234 of the
head. The network is a ResNet18 (He et al., "Deep Residual Learning", CVPR 2016) with basic blocks
and a quarter of the channels; its stem is a 3x3 convolution of stride 1, without max-pooling.

Pinhole cameras 1.4 from the origin look at it, with a field of view of 90° (the focal length is
half the image). What the released projection resolves to:

    view   row axis   column axis   depth - 1.4   camera at
    0      -y         +x            +z            (0, 0, -1.4)
    1      -y         -z            +x            (-1.4, 0, 0)
    2      -y         -x            -z            (0, 0, 1.4)
    3      -y         +z            -x            (1.4, 0, 0)
    4      -z         +x            -y            (0, 1.4, 0)
    5      +z         +x            +y            (0, -1.4, 0)

A point fills one pixel: row ceil(u - 1/2) with u = (row coordinate / depth + 1) size / 2, the
column likewise. Points behind the camera or outside the frame are dropped.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Interval, MinLen
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.kernels.norms import Norm, active, head_norm, make_norm
from qs3.models.base import Backbone, Features, PointClassifier
from qs3.utils.settings import checked

Up = Literal["y", "z"]
Pixel = Literal["harmonic", "nearest"]
CAMERA_DISTANCE = 1.4
VIEWS = 6
View = Annotated[int, Interval(ge=0, lt=VIEWS)]
# (axis, sign) of row, column and depth
_TABLE = (
    ((1, -1), (0, 1), (2, 1)),
    ((1, -1), (2, -1), (0, 1)),
    ((1, -1), (0, -1), (2, -1)),
    ((1, -1), (2, 1), (0, -1)),
    ((2, -1), (0, 1), (1, -1)),
    ((2, 1), (0, 1), (1, 1)),
)
_TINY = 1e-12  # of the released code: no division by zero


@torch.no_grad()
def depth_images(
    points: Float[Tensor, "b n 3"],
    size: int = 128,
    *,
    views: Sequence[int] = tuple(range(VIEWS)),
    up: Up = "y",
    pixel: Pixel = "harmonic",
) -> Float[Tensor, "b v size size"]:
    """Depth per pixel, 0 where no point falls; no gradient reaches the points.

    Args:
        points: clouds about the origin, radius about 1.
        size: rows and columns of an image.
        views: rows of the table, in this order.
        up: the axis of the clouds that the cameras 0 to 3 see upright. "y": the table as it is,
            which is what the released code does, with QS3's z-up data too. "z": the clouds are
            turned by -90° about x first.
        pixel: depth where several points share a pixel. "harmonic": their harmonic mean, as
            released. "nearest": the smallest.

    Returns:
        float32, or float64 for float64 points; also under autocast.
    """
    with torch.autocast(points.device.type, enabled=False):
        x, y, z = points.to(torch.promote_types(points.dtype, torch.float32)).unbind(2)
        if up == "z":
            y, z = z, -y
        return _draw(torch.stack([x, y, z]), size, views, pixel)


def _draw(axes: Tensor, size: int, views: Sequence[int], pixel: Pixel) -> Tensor:
    signed = torch.stack([-axes, axes])  # views of it: a table would have to be carried there
    entries = [signed[(sign + 1) // 2, axis] for v in views for axis, sign in _TABLE[v]]
    rows, columns, depth = torch.stack(entries).unflatten(0, (len(views), 3)).unbind(1)
    depth = depth + CAMERA_DISTANCE  # [v, b, n]
    row = ((rows / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
    column = ((columns / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
    seen = (row >= 0) & (row < size) & (column >= 0) & (column < size) & (depth >= 0)
    where = torch.where(seen, row * size + column, size**2).long()  # the last one is none of them
    empty = torch.zeros_like(depth[:, :, :1]).repeat(1, 1, size**2 + 1)
    if pixel == "nearest":
        flat = (empty + torch.inf).scatter_reduce(2, where, depth, "amin")
        flat = torch.where(flat == torch.inf, 0, flat)
    else:
        weight = torch.where(seen, 1 / (depth + _TINY), 0)
        total = empty.scatter_add(2, where, weight)
        flat = empty.scatter_add(2, where, depth * weight)
        flat = flat / torch.where(total == 0, 1, total)
    return flat[:, :, :-1].transpose(0, 1).unflatten(2, (size, size)).contiguous()


class ConvNorm(nn.Module):
    """Convolution without bias, then a norm. In eval a batch norm is folded into the weights."""

    def __init__(
        self, wide: int, narrow: int, kernel: int, stride: int = 1, norm: Norm = "batch"
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(wide, narrow, kernel, stride, kernel // 2, bias=False)
        self.norm = make_norm(norm, narrow, images=True)

    def forward(self, x: Float[Tensor, "i c h w"]) -> Float[Tensor, "i d r s"]:
        """norm(conv(x))."""
        conv, norm = self.conv, active(self.norm)
        if (
            norm.training
            or type(norm) is not nn.BatchNorm2d
            or norm.running_var is None
            or norm.running_mean is None
        ):
            return norm(conv(x))
        h = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        shift = norm.bias - h * norm.running_mean
        return F.conv2d(x, conv.weight * h[:, None, None, None], shift, conv.stride, conv.padding)


class BasicBlock(nn.Module):
    """relu(x' + norm(conv(relu(norm(conv(x)))))); x' is x, or a 1x1 convolution of it."""

    def __init__(self, wide: int, narrow: int, stride: int, norm: Norm = "batch") -> None:
        super().__init__()
        self.first = ConvNorm(wide, narrow, 3, stride, norm)
        self.second = ConvNorm(narrow, narrow, 3, norm=norm)
        plain = stride == 1 and wide == narrow
        # oneDNN's backward of a 1x1 convolution with a stride writes beyond its memory for 2 to 7
        # channels in channels-last layout (torch 2.x): the same by every other pixel.
        self.skip = stride if wide < 8 else 1
        self.shortcut = None if plain else ConvNorm(wide, narrow, 1, stride // self.skip, norm)

    def forward(self, x: Float[Tensor, "i c h w"]) -> Float[Tensor, "i d r s"]:
        """The block's output."""
        y = self.second(self.first(x).relu_())
        y += x if self.shortcut is None else self.shortcut(x[..., :: self.skip, :: self.skip])
        return y.relu_()


class ResNet18(nn.Module):
    """Images of one channel [I, 1, H, W] to features [I, 8 * `channels`].

    Kaiming-normal weights (fan out) except at the stem, which has torch's default; the last norm
    of each block starts with weight 0. Maps are kept in channels-last layout.

    `channels` are those at the stem; an "instance" norm is over each image.
    """

    def __init__(self, channels: int = 16, norm: Norm = "batch") -> None:
        super().__init__()
        self.feature_dim = 8 * channels
        self.stem = ConvNorm(1, channels, 3, norm=norm)
        blocks, wide = [], channels
        for stage in range(4):
            narrow = channels * 2**stage
            first = BasicBlock(wide, narrow, 1 + (stage > 0), norm)
            blocks += [first, BasicBlock(narrow, narrow, 1, norm)]
            wide = narrow
        self.blocks = nn.ModuleList(blocks)
        for block in blocks:
            for layer in block.modules():
                if isinstance(layer, nn.Conv2d):
                    nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
            for name, parameter in block.second.norm.named_parameters():
                if name.endswith("weight"):  # of each domain
                    nn.init.zeros_(parameter)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Float[Tensor, "i 1 h w"]) -> Float[Tensor, "i d"]:
        """Mean over the last maps."""
        x = self.stem(images.contiguous(memory_format=torch.channels_last)).relu_()
        for block in self.blocks:
            x = block(x)
        return x.mean((2, 3))


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
        up: Up = "y",
        pixel: Pixel = "harmonic",
        channels: int = 16,
        norm: Norm = "batch",
    ) -> None:
        super().__init__()
        self.views = tuple(views)
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
        norm: Norm = "batch",
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


@checked
def simpleview(
    num_classes: int,
    image_size: Annotated[int, Ge(8)] = 128,
    views: Annotated[tuple[View, ...], MinLen(1)] = tuple(range(VIEWS)),
    up: Up = "y",
    pixel: Pixel = "harmonic",
    channels: Annotated[int, Ge(1)] = 16,
    norm: Norm = "batch",
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
