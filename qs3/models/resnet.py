"""ResNet18/4: the image network of SimpleView, a ResNet18 with a quarter of the channels.

He et al., "Deep Residual Learning", CVPR 2016, with basic blocks; the stem is a 3x3 convolution
of stride 1 and there is no max-pooling. 699,888 parameters with 16 channels at the stem.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.kernels.norms import active, make_norm


class ConvNorm(nn.Module):
    """Convolution without bias, then a norm. In eval a batch norm is folded into the weights."""

    def __init__(
        self, wide: int, narrow: int, kernel: int, stride: int = 1, norm: str = "batch"
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

    def __init__(self, wide: int, narrow: int, stride: int, norm: str = "batch") -> None:
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

    Args:
        channels: at the stem.
        norm: see `qs3.kernels.norms`; "instance" is over each image.
    """

    def __init__(self, channels: int = 16, norm: str = "batch") -> None:
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
