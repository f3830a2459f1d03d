"""A training step of `qs3.models.resnet` on the CPU with few passes over memory and empty pixels.

The same sums as the plain network. What differs is what is computed, stored and when:
- Depth images are mostly empty: a stage works on windows of them and on one empty image where
  that pays (`qs3.models.fast.active_windows`).
- Of each convolution with its norm only the convolution's output y is kept. A norm is y h + s per
  channel, so relu(y h + s) is made again from y where it is read, some images at a time, which
  then lie in the cache: by the next convolution, and by that convolution's gradient.
- With dz the gradient of a norm's output,

      dy = h (dz - mean(dz) - x mean(dz x)),   x = (y - mean(y)) / sigma,

  is h dz + b y + c per channel, and made some images at a time as well. What has to be whole,
  because those means are over all images, is written in place.
- Maps lie as [image, row, column, channel], as oneDNN's convolutions like them best.

Maps are lists of parts (`Layout`). In the empty image's part a gradient is the sum of those of all
images that show it there; the affine term of dy counts once for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.models.fast.active_windows import Layout, cut, reach, recut, recut_back, whole, windows
from qs3.models.fast.pointwise_max import relu_gradient
from qs3.models.norms import active, track

_AT_ONCE = 1 << 19  # values of a map worked on at once: 2 MB in float32
_WIDE = 512  # values of a row; short rows are slow, so several pixels make one

Maps = list[Tensor]  # parts [i, h, w, c]
Source = Callable[[int], Tensor]  # of a part, what a layer reads: [i, h, w, c]


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

    def __init__(
        self, modules: Any, parameters: Iterator[Tensor], room: _Room, layout: Layout
    ) -> None:
        self.norm, self.room, self.layout = active(modules.norm), room, layout
        self.stride, self.padding = modules.conv.stride, modules.conv.padding
        self.weight, self.gamma, self.beta = next(parameters), next(parameters), next(parameters)
        self.y: Maps = []

    def convolve(self, x: Tensor, part: int) -> None:
        """Convolve x [i, h, w, c], a part of the input. Parts come in order."""
        y = F.conv2d(x.permute(0, 3, 1, 2), self.weight, None, self.stride, self.padding)
        y = y.permute(0, 2, 3, 1).contiguous()
        piece = self.layout.piece(part)
        if piece and len(piece.rim):
            seen = _pixels(self.y[0]).index_select(0, piece.under)
            _pixels(y).index_copy_(0, piece.rim, seen)
        self.y.append(y)

    def normalise(self) -> None:
        """Statistics of the whole output, running ones too; after it `scaled` can be asked."""
        mean, var, count = self._statistics()
        track(self.norm, mean, var, count)
        self.mean = mean.to(self.gamma.dtype)
        self.inverse = (var + self.norm.eps).rsqrt().to(self.gamma.dtype)
        self.h = self.gamma * self.inverse
        self.s = self.beta - self.h * self.mean
        self.sums = self.h.new_zeros(2, len(self.h), dtype=torch.float64)  # of dz, of dz y

    def _statistics(self) -> tuple[Tensor, Tensor, int]:
        """Mean and variance of each channel, from those of the parts; values of a channel."""
        found: list[tuple[Tensor, Tensor, int]] = []
        for part in self.layout.parts:
            y, empty = self.y[part], self.layout.empty
            if empty is not None and part == 0:
                n = int(empty.sum())
                share = empty.to(y.dtype) / max(n, 1)
                mean = share @ _pixels(y)
                var = share @ (_pixels(y) - mean).square()
            else:
                n = y.numel() // y.shape[3]
                mean, var = torch.batch_norm_update_stats(y.permute(0, 3, 1, 2), None, None, 0.0)
            found.append((mean.double(), var.double(), n))
        counts = torch.tensor([n for _, _, n in found], dtype=torch.float64)
        means, variances = (torch.stack(values) for values in list(zip(*found, strict=True))[:2])
        share = counts / counts.sum()
        mean = share @ means
        return mean, share @ (variances + (means - mean).square()), int(counts.sum())

    def scaled(self, part: int, room: int = 0) -> Tensor:
        """The norm's output y h + s of a part, until this room is used again."""
        y = self.y[part]
        rows = _rows(y)
        out = self.room(room, rows)
        return torch.addcmul(_wide(self.s, rows), rows, _wide(self.h, rows), out=out).view(y.shape)

    def relu(self, part: int) -> Tensor:
        """The same through ReLU, until room 0 is used again."""
        return self.scaled(part).relu_()

    def count(self, dz: Tensor, part: int) -> None:
        """Add dz of a part to the sums of dz and of dz y."""
        rows, channels = _rows(dz), len(self.h)
        product = torch.mul(rows, _rows(self.y[part]), out=self.room(1, rows))
        for total, values in zip(self.sums, (rows, product), strict=True):
            total += values.sum(0).view(-1, channels).sum(0, dtype=torch.float64)

    def counted(self) -> None:
        """After all parts: the norm's gradients are known and `back` can be asked."""
        dbeta, dzy = self.sums
        dgamma = (dzy - self.mean * dbeta) * self.inverse
        values = self.layout.images * self.layout.h * self.layout.w
        b = -self.h * self.inverse * dgamma / values
        c = -self.h * dbeta / values - b * self.mean
        self.b, self.c = b.to(self.h.dtype), c.to(self.h.dtype)
        self.dweight = torch.zeros_like(self.weight)
        self.gradients = (self.dweight, dgamma.to(self.h.dtype), dbeta.to(self.h.dtype))
        if self.layout.empty is not None:
            self.rims = torch.zeros_like(_pixels(self.y[0]))  # gradients out of the windows

    def back(self, dz: Tensor, x: Tensor, part: int, *, need_x: bool = True) -> Tensor:
        """Gradient of a part of the input x; adds to that of the weight. The last part first."""
        y, empty = self.y[part], self.layout.empty
        rows = _rows(y)
        dy = self.room(1, rows)
        torch.addcmul(_wide(self.c, rows), rows, _wide(self.b, rows), out=dy)
        piece = self.layout.piece(part)
        if empty is not None and not piece:
            pixels = dy.view(self.rims.shape)
            pixels.mul_(empty[:, None]).add_(self.rims)
        dy.addcmul_(_rows(dz), _wide(self.h, rows))
        if piece and len(piece.rim):
            pixels = dy.view(-1, len(self.h))
            self.rims.index_add_(0, piece.under, pixels.index_select(0, piece.rim))
            pixels.index_fill_(0, piece.rim, 0)
        dx, dweight, _ = torch.ops.aten.convolution_backward(
            dy.view(y.shape).permute(0, 3, 1, 2), x.permute(0, 3, 1, 2), self.weight, None,
            self.stride, self.padding, (1, 1), False, (0, 0), 1, (need_x, True, False),
        )  # fmt: skip
        self.dweight += dweight
        return dx.permute(0, 2, 3, 1).contiguous() if need_x else dz


class _Block:
    """What one `BasicBlock` keeps; `out` is its output, `source` its input."""

    def __init__(self, first: _Layer, second: _Layer, shortcut: _Layer | None) -> None:
        self.first, self.second, self.shortcut = first, second, shortcut
        self.layers = [first, second] + ([shortcut] if shortcut else [])
        self.parts = second.layout.parts

    def forward(self, source: Source) -> Maps:
        self.source = source
        first, second, shortcut = self.first, self.second, self.shortcut
        for part in self.parts:
            x = source(part)
            for layer in (first, shortcut):
                if layer:
                    layer.convolve(x, part)
        first.normalise()
        for part in self.parts:
            second.convolve(first.relu(part), part)
        second.normalise()
        if shortcut:
            shortcut.normalise()
        self.out = []
        for part in self.parts:
            skip = shortcut.scaled(part) if shortcut else source(part)
            self.out.append(torch.add(second.scaled(part, room=1), skip).relu_())
        return self.out

    def backward(self, g: Maps) -> Maps:
        """Gradient of the output, written over, to that of the input."""
        first, second, shortcut = self.first, self.second, self.shortcut
        for part in self.parts:
            dz = relu_gradient(g[part], self.out[part])
            second.count(dz, part)
            if shortcut:
                shortcut.count(dz, part)
        second.counted()
        inner: dict[int, Tensor] = {}  # gradient of the first norm's output
        for part in reversed(self.parts):
            x = first.relu(part)
            inner[part] = second.back(g[part], x, part)
            first.count(relu_gradient(inner[part], x), part)
        first.counted()
        if shortcut:
            shortcut.counted()
        for part in reversed(self.parts):
            x = self.source(part)
            dx = first.back(inner.pop(part), x, part)
            skip = shortcut.back(g[part], x, part) if shortcut else g[part]
            g[part] = dx.add_(skip)
        return g


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Tensor, net: Any, *parameters: Tensor) -> Tensor:
        given, room, stages = iter(parameters), _Room(), _stages(net)
        layouts = _layouts(images[:, 0] != 0, net)
        stem = _Layer(net.stem, given, room, layouts[0])
        maps = cut(images.permute(0, 2, 3, 1), layouts[0])
        for part in layouts[0].parts:
            stem.convolve(maps[part], part)
        stem.normalise()
        source: Source = stem.relu
        ctx.stem, ctx.maps, ctx.layouts, ctx.stages = stem, maps, layouts, []
        out: Maps = []
        for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True)):
            if k:
                source = recut(out, layouts[k - 1], _wider(layouts, k)).__getitem__
            blocks = []
            for modules in stage:
                layers = (_Layer(m, given, room, layout) if m else None for m in _layers(modules))
                blocks.append(_Block(*layers))  # type: ignore[arg-type]
                out = blocks[-1].forward(source)
                source = out.__getitem__
            ctx.stages.append(blocks)
        return _mean(out, layouts[-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        stem, layouts = ctx.stem, ctx.layouts
        g = _mean_back(grad, layouts[-1])
        for k in reversed(range(len(layouts))):
            for block in reversed(ctx.stages[k]):
                g = block.backward(g)
            if k:
                g = recut_back(g, layouts[k - 1], _wider(layouts, k))
        for part in layouts[0].parts:
            stem.count(relu_gradient(g[part], stem.relu(part)), part)
        stem.counted()
        for part in reversed(layouts[0].parts):
            stem.back(g[part], ctx.maps[part], part, need_x=False)
        layers = [stem, *(layer for s in ctx.stages for block in s for layer in block.layers)]
        return None, None, *(d for layer in layers for d in layer.gradients)


def _mean(maps: Maps, layout: Layout) -> Tensor:
    """Mean over the pixels of each image: [i, c]."""
    return recut(maps, layout, _one_part(layout))[0].mean((1, 2))


def _mean_back(grad: Tensor, layout: Layout) -> Maps:
    h, w = layout.h, layout.w
    g = (grad / (h * w))[:, None, None].repeat(1, h, w, 1)
    return recut_back([g], layout, _one_part(layout))


def _one_part(layout: Layout) -> Layout:
    return whole(layout.images, layout.h, layout.w, layout.images * layout.h * layout.w)


def _stages(net: Any) -> list[list[Any]]:
    """Blocks whose outputs are of one size."""
    stages: list[list[Any]] = [[]]
    for block in net.blocks:
        if block.first.conv.stride[0] > 1:
            stages.append([])
        stages[-1].append(block)
    return stages


def _layouts(filled: Tensor, net: Any) -> list[Layout]:
    """How each stage's maps are kept: windows as long as they are worth it, then whole images."""
    images, h, w = filled.shape
    rows, columns = reach(filled.any(2)), reach(filled.any(1))
    layouts: list[Layout] = []
    for stage in _stages(net):
        stride = stage[0].first.conv.stride[0]
        convs = 2 * len(stage) + (0 if layouts else 1)  # the stem
        tight = (layouts[-1].empty is not None) if layouts else True
        if stride > 1:  # an output pixel sees the inputs from stride * it - 1 to stride * it + 1
            tight = tight and h % stride == 0 and w % stride == 0
            h, w, convs = -(-h // stride), -(-w // stride), convs - 1
            rows, columns = ((first // stride, end // stride + 1) for first, end in (rows, columns))
        rows, columns = ((first - convs, end + convs) for first, end in (rows, columns))
        at_once = _AT_ONCE // stage[0].second.conv.out_channels
        found = windows(rows, columns, h, w, at_once) if tight else None
        layouts.append(found or whole(images, h, w, at_once))
    return layouts


def _wider(layouts: list[Layout], stage: int) -> Layout:
    """A stage's windows in the maps that it reads."""
    before = layouts[stage - 1]
    return layouts[stage].before(-(-before.h // layouts[stage].h), before.h, before.w)


def _pixels(maps: Tensor) -> Tensor:
    """[i, h, w, c] as [pixels, c], a view."""
    return maps.view(-1, maps.shape[3])


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


def _layers(block: Any) -> tuple[Any, Any, Any]:
    """Convolutions with their norms; the last one, of the shortcut, may be None."""
    return block.first, block.second, block.shortcut


def _modules(net: Any) -> list[Any]:
    """All of them, in the order of their parameters here."""
    return [net.stem, *(m for block in net.blocks for m in _layers(block) if m)]


def can_step(net: nn.Module, images: Tensor) -> bool:
    """Whether `step` gives what the plain net does: batch norms in training."""
    norms = [active(module.norm) for module in _modules(net)]
    plain = all(
        type(n) is nn.BatchNorm2d and n.training and n.affine and n.track_running_stats
        for n in norms
    )  # fmt: skip
    same = images.dtype == norms[0].weight.dtype
    return plain and same and not torch.is_autocast_enabled("cpu") and not images.requires_grad


def step(net: nn.Module, images: Tensor) -> Tensor:
    """The features of a `ResNet18` in train mode: [I, 1, H, W] to [I, D], no gradient of images."""
    parameters = []
    for module in _modules(net):
        norm = active(module.norm)
        parameters += [module.conv.weight, norm.weight, norm.bias]
    return _Step.apply(images, net, *parameters)
