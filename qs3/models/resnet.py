"""ResNet18/4: the image network of SimpleView, a ResNet18 with a quarter of the channels.

He et al., "Deep Residual Learning", CVPR 2016, with basic blocks; the stem is a 3x3 convolution
of stride 1 and there is no max-pooling. 699,888 parameters with 16 channels at the stem.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


class ConvNorm(nn.Module):
    """Convolution without bias, then batch norm. In eval the norm is folded into the weights."""

    def __init__(self, wide: int, narrow: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(wide, narrow, kernel, stride, kernel // 2, bias=False)
        self.norm = nn.BatchNorm2d(narrow)

    def forward(self, x: Float[Tensor, "i c h w"]) -> Float[Tensor, "i d r s"]:
        """norm(conv(x))."""
        conv, norm = self.conv, self.norm
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

    def __init__(self, wide: int, narrow: int, stride: int) -> None:
        super().__init__()
        self.first = ConvNorm(wide, narrow, 3, stride)
        self.second = ConvNorm(narrow, narrow, 3)
        plain = stride == 1 and wide == narrow
        self.shortcut = None if plain else ConvNorm(wide, narrow, 1, stride)

    def forward(self, x: Float[Tensor, "i c h w"]) -> Float[Tensor, "i d r s"]:
        """The block's output."""
        y = self.second(self.first(x).relu_())
        y += x if self.shortcut is None else self.shortcut(x)
        return y.relu_()


class ResNet18(nn.Module):
    """Images of one channel [I, 1, H, W] to features [I, 8 * `channels`].

    Kaiming-normal weights (fan out) except at the stem, which has torch's default; the last norm
    of each block starts with weight 0. Maps are kept in channels-last layout.
    """

    def __init__(self, channels: int = 16) -> None:
        super().__init__()
        self.feature_dim = 8 * channels
        self.stem = ConvNorm(1, channels, 3)
        blocks, wide = [], channels
        for stage in range(4):
            narrow = channels * 2**stage
            blocks += [BasicBlock(wide, narrow, 1 + (stage > 0)), BasicBlock(narrow, narrow, 1)]
            wide = narrow
        self.blocks = nn.ModuleList(blocks)
        for block in blocks:
            for layer in block.modules():
                if isinstance(layer, nn.Conv2d):
                    nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
            nn.init.zeros_(block.second.norm.weight)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Float[Tensor, "i 1 h w"]) -> Float[Tensor, "i d"]:
        """Mean over the last maps."""
        x = self.stem(images.contiguous(memory_format=torch.channels_last)).relu_()
        for block in self.blocks:
            x = block(x)
        return x.mean((2, 3))
