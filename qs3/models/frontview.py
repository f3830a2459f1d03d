"""A small image net on one picture of a cloud, from where its camera stood.

Single depth views are pictures: neighbours in the picture say more than neighbours in space. Clouds
lie as `data.scale=seen` puts them: the camera looks along +y, z is up. The picture is orthographic,
as wide and high as the cloud, and the head also gets the cloud's sizes and heights. 767,930
parameters for 10 classes. (Ours.)
"""

from typing import Annotated

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.kernels.norms import Norm, head_norm, make_norm
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.models.simpleview import BasicBlock, ConvNorm
from qs3.utils.settings import checked

CHANNELS, SIZES = 5, 8
_MARGIN = 1.05
_LEAST = 0.05  # sides of a picture; a smaller cloud does not fill it
_HEIGHT = 0.7  # about the middle of what stands in a room


@torch.no_grad()
def front_pictures(points: Float[Tensor, "b n 3"], size: int) -> Float[Tensor, "b 5 size size"]:
    """What a camera that looks along +y sees; pixels where no point falls are 0.

    Channels: how far a pixel is behind the cloud's middle, as a share of half the picture's side,
    and in the cloud's unit; its height; whether a point falls there, and whether one falls there or
    next to it. Where several fall, the nearest counts.
    """
    low, high = points.amin(1), points.amax(1)
    side = _MARGIN * (high - low)[:, [0, 2]].amax(1).clamp(min=_LEAST)  # [B]
    at = (points - (low + high)[:, None] / 2) / side[:, None, None] + 0.5
    column, row = (size * at[..., 0]).long(), (size * (1 - at[..., 2])).long()
    pixel = row.clamp(0, size - 1) * size + column.clamp(0, size - 1)  # [B, N]
    depth = points[..., 1]
    empty = torch.full_like(depth[:, :1], torch.inf).repeat(1, size**2)
    nearest = empty.scatter_reduce(1, pixel, depth, "amin").gather(1, pixel)
    behind = depth - depth.mean(dim=1, keepdim=True)
    there = torch.ones_like(depth)
    values = [2 * behind / side[:, None], behind, points[..., 2] - _HEIGHT, there]
    seen = torch.stack(values, dim=1) * (depth <= nearest)[:, None]  # [B, 4, N]
    picture = torch.zeros_like(seen[..., :1]).repeat(1, 1, size**2)
    picture = picture.scatter_add(2, pixel[:, None].expand_as(seen), seen)
    picture = picture / picture[:, 3:].clamp(min=1)  # equally near ones are averaged
    picture = picture.unflatten(2, (size, size))
    return torch.cat([picture, F.max_pool2d(picture[:, 3:], 3, 1, 1)], dim=1)


@torch.no_grad()
def sizes(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 8"]:
    """Logarithms of the extents; lowest, highest and mean height; spread along x and y."""
    low, high = points.amin(1), points.amax(1)
    level = points[..., :2].std(dim=1, correction=0)
    heights = [low[:, 2:], high[:, 2:], points[..., 2].mean(dim=1, keepdim=True)]
    return torch.cat([(high - low).clamp(min=0.01).log(), *heights, level], dim=1)


class FrontView(Backbone):
    """Greatest and mean features of the picture, and the cloud's sizes; a point has none.

    Args:
        image_size: rows and columns of the picture.
        channels: at the stem; after two blocks twice, after four four times as many.
        norm: see `qs3.kernels.norms`; "instance" is over each image.
    """

    def __init__(self, image_size: int = 48, channels: int = 32, norm: Norm = "batch") -> None:
        super().__init__()
        self.image_size = image_size
        self.stem = ConvNorm(CHANNELS, channels, 3, norm=norm)
        blocks, wide = [], channels
        for narrow in (channels, 2 * channels, 4 * channels):
            blocks += [BasicBlock(wide, narrow, 2, norm), BasicBlock(narrow, narrow, 1, norm)]
            wide = narrow
        self.blocks = nn.Sequential(*blocks)
        self.sizes = make_norm(head_norm(norm), SIZES)
        self.feature_dim = 2 * wide + SIZES
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to [B, 8 * `channels` + 8]."""
        dtype = self.stem.conv.weight.dtype
        with torch.autocast(points.device.type, enabled=False):
            points = points.to(torch.promote_types(points.dtype, torch.float32))
            pictures, of_cloud = front_pictures(points, self.image_size), sizes(points)
        pictures = pictures.to(dtype).contiguous(memory_format=torch.channels_last)
        x = self.blocks(self.stem(pictures).relu_())
        found = [x.amax((2, 3)), x.mean((2, 3)), self.sizes(of_cloud.to(dtype))]
        return Features(torch.cat(found, dim=1), None)


@checked
def frontview(
    num_classes: int,
    image_size: Annotated[int, Ge(8)] = 48,
    channels: Annotated[int, Ge(1)] = 32,
    norm: Norm = "batch",
    dropout: float = 0.4,
) -> PointClassifier:
    """The picture's net and a head with one hidden layer."""
    backbone = FrontView(image_size, channels, norm)
    return with_head(backbone, num_classes, hidden=(256,), dropout=dropout, norm=norm)
