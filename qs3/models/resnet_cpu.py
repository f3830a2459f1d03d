"""A training step of `ResNet18` on the CPU with few passes over memory.

The same sums as the plain network. What differs is what is stored and when:
- Of each convolution with its norm only the convolution's output y is kept. A norm is y h + s per
  channel, so relu(y h + s) is made again from y where it is read, some images at a time, which
  then lie in the cache: by the next convolution, and by that convolution's gradient.
- With dz the gradient of a norm's output,

      dy = h (dz - mean(dz) - x mean(dz x)),   x = (y - mean(y)) / sigma,

  is h dz + b y + c per channel, and made some images at a time as well. What has to be whole,
  because those means are over all images, is written in place.
- Maps lie as [image, row, column, channel], as oneDNN's convolutions like them best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.models.resnet import ConvNorm, ResNet18

_AT_ONCE = 1 << 19  # values of a map worked on at once: 2 MB in float32
_WIDE = 512  # values of a row; short rows are slow, so several pixels make one

Source = Callable[[slice], Tensor]  # of some images, what a layer reads: [i, h, w, c]


class _Room:
    """Two pieces of memory, written over and over: 0 for a layer's input, 1 for the rest."""

    def __init__(self) -> None:
        self._flat: dict[int, Tensor] = {}

    def __call__(self, which: int, like: Tensor) -> Tensor:
        flat = self._flat.get(which)
        if flat is None or flat.numel() < like.numel():
            flat = self._flat[which] = like.new_empty(like.numel())
        return flat[: like.numel()].view(like.shape)


class _Layer:
    """A convolution and its norm: the convolution's output, and what the norm makes of it."""

    def __init__(self, modules: ConvNorm, parameters: Iterator[Tensor], room: _Room) -> None:
        self.norm, self.room = modules.norm, room
        self.stride, self.padding = modules.conv.stride, modules.conv.padding
        self.weight, self.gamma, self.beta = next(parameters), next(parameters), next(parameters)

    def convolve(self, x: Tensor, part: slice, images: int) -> None:
        """Convolve x [i, h, w, c], the input of some of all `images`."""
        y = F.conv2d(x.permute(0, 3, 1, 2), self.weight, None, self.stride, self.padding)
        y = y.permute(0, 2, 3, 1)
        if part.start == 0:
            self.y = y.new_empty(images, *y.shape[1:])
        self.y[part] = y

    def normalise(self) -> None:
        """Statistics of the whole output, running ones too; after it `scaled` can be asked."""
        norm = self.norm
        assert norm.momentum is not None
        assert norm.num_batches_tracked is not None
        self.mean, var = torch.batch_norm_update_stats(
            self.y.permute(0, 3, 1, 2), norm.running_mean, norm.running_var, norm.momentum
        )
        norm.num_batches_tracked.add_(1)
        self.inverse = (var + norm.eps).rsqrt()
        self.h = self.gamma * self.inverse
        self.s = self.beta - self.h * self.mean
        self.sums = self.h.new_zeros(2, len(self.h), dtype=torch.float64)  # of dz, of dz y

    def scaled(self, part: slice, room: int = 0) -> Tensor:
        """The norm's output y h + s of some images, until this room is used again."""
        y = self.y[part]
        rows = _rows(y)
        out = self.room(room, rows)
        return torch.addcmul(_wide(self.s, rows), rows, _wide(self.h, rows), out=out).view(y.shape)

    def relu(self, part: slice) -> Tensor:
        """The same through ReLU, until room 0 is used again."""
        return self.scaled(part).relu_()

    def count(self, dz: Tensor, part: slice) -> None:
        """Add dz of some images to the sums of dz and of dz y."""
        rows, channels = _rows(dz), len(self.h)
        product = torch.mul(rows, _rows(self.y[part]), out=self.room(1, rows))
        for total, values in zip(self.sums, (rows, product), strict=True):
            total += values.sum(0).view(-1, channels).sum(0, dtype=torch.float64)

    def counted(self) -> None:
        """After all images: the norm's gradients are known and `back` can be asked."""
        dbeta, dzy = self.sums
        dgamma = (dzy - self.mean * dbeta) * self.inverse
        values = self.y.numel() // len(self.h)
        b = -self.h * self.inverse * dgamma / values
        c = -self.h * dbeta / values - b * self.mean
        self.b, self.c = b.to(self.h.dtype), c.to(self.h.dtype)
        self.dweight = torch.zeros_like(self.weight)
        self.gradients = (self.dweight, dgamma.to(self.h.dtype), dbeta.to(self.h.dtype))

    def back(self, dz: Tensor, x: Tensor, part: slice, *, need_x: bool = True) -> Tensor:
        """Gradient of the input x of some images; adds to that of the weight."""
        y = self.y[part]
        rows = _rows(y)
        dy = self.room(1, rows)
        torch.addcmul(_wide(self.c, rows), rows, _wide(self.b, rows), out=dy)
        dy.addcmul_(_rows(dz), _wide(self.h, rows))
        dx, dweight, _ = torch.ops.aten.convolution_backward(
            dy.view(y.shape).permute(0, 3, 1, 2), x.permute(0, 3, 1, 2), self.weight, None,
            self.stride, self.padding, (1, 1), False, (0, 0), 1, (need_x, True, False),
        )  # fmt: skip
        self.dweight += dweight
        return dx.permute(0, 2, 3, 1) if need_x else dz


class _Block:
    """What one `BasicBlock` keeps; `out` is its output, `shape` and `source` its input."""

    def __init__(self, first: _Layer, second: _Layer, shortcut: _Layer | None) -> None:
        self.first, self.second, self.shortcut = first, second, shortcut
        self.layers = [first, second] + ([shortcut] if shortcut else [])

    def forward(self, source: Source, shape: tuple[int, ...]) -> None:
        self.source, self.shape = source, shape
        first, second, shortcut = self.first, self.second, self.shortcut
        for part in _parts(shape):
            x = source(part)
            for layer in (first, shortcut):
                if layer:
                    layer.convolve(x, part, shape[0])
        first.normalise()
        for part in _parts(first.y.shape):
            second.convolve(first.relu(part), part, shape[0])
        second.normalise()
        if shortcut:
            shortcut.normalise()
        self.out = torch.empty_like(second.y)
        for part in _parts(self.out.shape):
            skip = shortcut.scaled(part) if shortcut else source(part)
            torch.add(second.scaled(part, room=1), skip, out=self.out[part]).relu_()

    def backward(self, g: Tensor) -> Tensor:
        """Gradient of the output, written over, to that of the input."""
        first, second, shortcut = self.first, self.second, self.shortcut
        for part in _parts(g.shape):
            dz = _mask(g[part], self.out[part])
            second.count(dz, part)
            if shortcut:
                shortcut.count(dz, part)
        second.counted()
        inner = torch.empty_like(g)  # gradient of the first norm's output
        for part in _parts(g.shape):
            x = first.relu(part)
            inner[part] = second.back(g[part], x, part)
            first.count(_mask(inner[part], x), part)
        first.counted()
        if shortcut is None:
            for part in _parts(g.shape):
                g[part] += first.back(inner[part], self.source(part), part)
            return g
        shortcut.counted()
        out = g.new_empty(self.shape)
        for part in _parts(out.shape):
            x = self.source(part)
            dx, dskip = first.back(inner[part], x, part), shortcut.back(g[part], x, part)
            torch.add(dx, dskip, out=out[part])
        return out


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Tensor, net: ResNet18, *parameters: Tensor) -> Tensor:
        given, room = iter(parameters), _Room()
        stem = _Layer(net.stem, given, room)
        blocks = []
        for modules in net.blocks:
            layers = (_Layer(m, given, room) if m else None for m in _layers(modules))
            blocks.append(_Block(*layers))  # type: ignore[arg-type]
        maps = images.permute(0, 2, 3, 1)
        for part in _parts((*maps.shape[:3], len(stem.gamma))):
            stem.convolve(maps[part], part, len(maps))
        stem.normalise()
        source: Source = stem.relu
        shape = tuple(stem.y.shape)
        for block in blocks:
            block.forward(source, shape)
            source, shape = block.out.__getitem__, tuple(block.out.shape)
        ctx.stem, ctx.blocks, ctx.maps = stem, blocks, maps
        return blocks[-1].out.mean((1, 2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        stem, blocks = ctx.stem, ctx.blocks
        _, h, w, _ = blocks[-1].out.shape
        g = (grad / (h * w))[:, None, None].repeat(1, h, w, 1)
        for block in reversed(blocks):
            g = block.backward(g)
        for part in _parts(g.shape):
            stem.count(_mask(g[part], stem.relu(part)), part)
        stem.counted()
        for part in _parts(g.shape):
            stem.back(g[part], ctx.maps[part], part, need_x=False)
        layers = [stem, *(layer for block in blocks for layer in block.layers)]
        return None, None, *(d for layer in layers for d in layer.gradients)


def _parts(shape: tuple[int, ...]) -> Iterator[slice]:
    """All images of maps, some at a time."""
    images, h, w, c = shape
    step = max(1, _AT_ONCE // (h * w * c))
    return (slice(i, min(i + step, images)) for i in range(0, images, step))


def _rows(maps: Tensor) -> Tensor:
    """[i, h, w, c] as [rows, pixels * c], a view."""
    _, h, w, c = maps.shape
    pixels = 1
    while pixels * c < _WIDE and (h * w) % (2 * pixels) == 0:
        pixels *= 2
    return maps.view(-1, pixels * c)


def _wide(values: Tensor, rows: Tensor) -> Tensor:
    """One value a channel, for each pixel of a row."""
    return values.repeat(rows.shape[1] // len(values))


def _mask(g: Tensor, out: Tensor) -> Tensor:
    """Gradient through relu, in place."""
    return torch.ops.aten.threshold_backward.grad_input(g, out, 0, grad_input=g)


def _layers(block: nn.Module) -> tuple[ConvNorm, ConvNorm, ConvNorm | None]:
    return block.first, block.second, block.shortcut  # type: ignore[return-value]


def can_step(net: ResNet18, images: Tensor) -> bool:
    """Whether `step` gives what `net(images)` does: plain norms in training, on the CPU."""
    norms = [m.norm for m in net.modules() if isinstance(m, ConvNorm)]
    plain = all(
        type(n) is nn.BatchNorm2d and n.training and n.affine and n.track_running_stats
        and n.momentum is not None
        for n in norms
    )  # fmt: skip
    same = images.device.type == "cpu" and images.dtype == net.stem.conv.weight.dtype
    return plain and same and not torch.is_autocast_enabled("cpu") and not images.requires_grad


def step(net: ResNet18, images: Tensor) -> Tensor:
    """`net(images)` in train mode: [I, 1, H, W] to [I, D]. The images get no gradient."""
    modules = [net.stem, *(m for block in net.blocks for m in _layers(block) if m)]
    parameters = [p for m in modules for p in (m.conv.weight, m.norm.weight, m.norm.bias)]
    return _Step.apply(images, net, *parameters)
