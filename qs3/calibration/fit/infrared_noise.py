"""How infrared pictures of a still scene change from frame to frame: a camera's noise, and speckle.

Noise of photons and of the read-out is each pixel's own; laser speckle lies on the dots before the
lens, which spreads a grain over neighbours. So it is told by the covariance of neighbours over
time, on the very pixels whose variance holds the noise: the dots themselves need not be known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F

from qs3.calibration.fit.infrared_statistics import inner
from qs3.sensors.gradients.twin import gaussian

BRIGHTNESSES = 8
"""Bins of brightness, as many pixels in each, in which the noise is taken."""

APART = 3
"""Covariances of a pixel with itself (its variance), its neighbours, and those 2 px away."""

_TILES = 6  # along each side, of the jackknife
# What the variance of speckle in one bin differs by between two patterns of dots: a share of it
# and, where it is no more than what the lens spreads from dots, of its mean.
_DOTS_ERROR, _TAILS_ERROR = 0.05, 0.002
_STEP = 1 / 12  # variance of rounding to grey values ...
_FINE = 0.4  # ... which is noise of its own if there is this much in all (else it is the level's)

Fields = dict[str, torch.Tensor]
"""What a lens makes of light and grains, by name; [h, w] each, but for its width."""


@dataclass(frozen=True, eq=False)
class OverTime:
    """Of the frames of one still scene; grey values.

    Attributes:
        level: [B] mean of each bin.
        moments: [B, APART] covariance over time of a pixel with those 0, 1 and 2 px away.
        root: [B, APART, APART] inverse Cholesky factor of the moments' own covariance, from tiles
            of the picture; what is multiplied by it is in standard errors.
        parts: [T, B, APART] the moments where one tile of the picture is left out.
        known: [B] bool; the bin is neither black nor white, and its noise is above rounding.
        sorters: frames whose mean the bins are made of.
    """

    level: torch.Tensor
    moments: torch.Tensor
    root: torch.Tensor
    parts: torch.Tensor
    known: torch.Tensor
    sorters: int


def over_time(frames: Sequence[torch.Tensor]) -> OverTime | None:
    """The noise in two or more frames [h, w] float64; None of fewer.

    Four and more are parted: one half sorts the pixels by brightness, noise is the other's.
    A bright grain would else be noise of a bright pixel.
    """
    if len(frames) < 2:
        return None
    stack = torch.stack(list(frames))
    halves = [(stack, stack)]
    if len(stack) >= 4:
        halves = [(stack[::2], stack[1::2]), (stack[1::2], stack[::2])]
    sums = [_tiled(sorting.mean(dim=0), measured) for sorting, measured in halves]
    total = torch.stack(sums).sum(dim=0)  # [T, B, 2 + APART]: pixels, level, moments
    whole = total.sum(dim=0)
    values = whole[:, 1:] / whole[:, :1]
    others = whole - total
    each = (others[..., 1:] / others[..., :1].clamp_min(1))[..., 1:]  # a tile left out
    tiles = len(total)
    centred = each - each.mean(dim=0)
    scatter = (tiles - 1) / tiles * torch.einsum("tbi,tbj->bij", centred, centred)
    level, moments = values[:, 0], values[:, 1:]
    # No bin is surer than what the model of light is.
    floor = torch.diag_embed((2e-3 * moments[:, :1]).expand(-1, APART) ** 2 + 1e-12)
    root = torch.linalg.inv(torch.linalg.cholesky(scatter + floor))
    spread = 3 * moments[:, 0].sqrt()
    known = (level > spread) & (level < 255 - spread) & (moments[:, 0] > _FINE)
    return OverTime(level, moments, root, each, known, len(halves[0][0]))


def _tiled(brightness: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
    """[T, B, 2 + APART] sums over the pixels of each tile and bin: 1, level, moments."""
    mean = frames.mean(dim=0)
    apart = frames - mean
    columns = [torch.ones_like(mean), mean]
    for lag in range(APART):
        moved = [torch.roll(apart, step, axis) for axis in (1, 2) for step in (lag, -lag)]
        columns.append((apart * sum(moved)).sum(dim=0) / 4 / (len(frames) - 1))
    values = torch.stack([inner(one).flatten() for one in columns])
    shape = inner(mean).shape
    rows, cols = (torch.arange(n) * _TILES // n for n in shape)
    tile = (rows[:, None] * _TILES + cols).flatten()
    chosen = _equal_parts(inner(brightness).flatten(), BRIGHTNESSES)
    out = torch.zeros(len(values), _TILES**2 * BRIGHTNESSES, dtype=values.dtype)
    out.index_add_(1, tile * BRIGHTNESSES + chosen, values)
    return out.T.reshape(_TILES**2, BRIGHTNESSES, -1)


def _equal_parts(values: torch.Tensor, count: int) -> torch.Tensor:
    """[n] int64, 0 for the lowest n / count of the values and so on."""
    order = values.argsort()
    chosen = torch.empty_like(order)
    for i, part in enumerate(torch.tensor_split(order, count)):
        chosen[part] = i
    return chosen


class Speckled:
    """A patch of the twin's dots under speckle.

    Args:
        projected: [h, w] radiance by the projector before the lens.
        grain: [h, w] laser speckle; mean 0, variance 1.
        everywhere: ambient light has speckle, too.
    """

    def __init__(self, projected: torch.Tensor, grain: torch.Tensor, everywhere: bool) -> None:
        self._projected, self._grain, self._everywhere = projected, grain, everywhere
        self._kept = lru_cache(maxsize=2)(lambda width: self._through(torch.tensor(width)))
        self._bins: dict[tuple[float, ...], torch.Tensor] = {}
        drawn = torch.randn(projected.shape, generator=torch.Generator().manual_seed(0))
        self._own = inner(drawn.double()).flatten()  # noise of each pixel's own

    def behind(self, width: torch.Tensor) -> Fields:
        """What a lens of this width, px, makes of light and grains."""
        if forward_ad.unpack_dual(width).tangent is not None:
            return self._through(width)
        return self._kept(float(width))  # the search asks for it again, with other light

    def _through(self, width: torch.Tensor) -> Fields:
        kernel, light = gaussian(width.double().clamp_min(1e-3)), self._projected
        out = {
            "width": width.detach(),
            "dots": through(light, kernel, kernel),
            "grains": through(light * self._grain, kernel, kernel),
        }
        if self._everywhere:
            out["even"] = through(self._grain, kernel, kernel)
        squares = kernel**2
        for lag in range(APART):
            length = max(0, len(kernel) - lag)
            shared = kernel[lag:] * kernel[:length] / 2
            both = F.pad(shared, (0, len(kernel) - length)) + F.pad(
                shared, (len(kernel) - length, 0)
            )
            for power in (1, 2) if self._everywhere else (2,):
                field = through(light**power, squares, both) + through(light**power, both, squares)
                out[f"{power} {lag}"] = field / 2
            out[f"0 {lag}"] = squares.sum() * both.sum()
        return out

    def picture(
        self, fields: Fields, ambient: torch.Tensor, contrast: torch.Tensor
    ) -> torch.Tensor:
        """[h, w] radiance of one frame, behind a lens."""
        grains = fields["grains"]
        if self._everywhere:
            grains = grains + ambient * fields["even"]
        return ambient + fields["dots"] + contrast * grains

    def noise(
        self, fields: Fields, found: OverTime, ambient: torch.Tensor, contrast: torch.Tensor
    ) -> torch.Tensor:
        """[B, APART] covariances over time by speckle, in the bins that were found."""
        key = tuple(float(one) for one in (fields["width"], ambient, contrast))
        if key not in self._bins:
            self._bins = {key: self._binned(fields, found, *key[1:])}
        chosen = self._bins[key]
        columns = [inner(ambient + fields["dots"])]
        for lag in range(APART):
            squares = fields[f"2 {lag}"]
            if self._everywhere:
                squares = squares + 2 * ambient * fields[f"1 {lag}"]
                squares = squares + ambient**2 * fields[f"0 {lag}"]
            columns.append(inner(squares))
        values = torch.stack([one.flatten() for one in columns])  # [1 + APART, n]
        sums = torch.zeros(len(values), len(found.level), dtype=values.dtype)
        sums = sums.scatter_add(1, chosen.expand(len(values), -1), values)
        mean = (sums / torch.bincount(chosen)).T
        gain = found.level / mean[:, 0]
        return contrast**2 * gain[:, None] ** 2 * mean[:, 1:]

    def _binned(
        self, fields: Fields, found: OverTime, ambient: float, contrast: float
    ) -> torch.Tensor:
        """[n] each pixel's bin by brightness in the mean of a few frames, with its noise."""
        light = torch.tensor(ambient), torch.tensor(contrast / math.sqrt(found.sorters))
        seen = inner(self.picture(fields, *light)).detach().flatten()
        white = found.moments[:, 0] - found.moments[:, 1]  # at least; dark bins have little else
        spread = white.clamp_min(0).min().sqrt() * seen.mean() / found.level.mean()
        return _equal_parts(seen + spread / math.sqrt(found.sorters) * self._own, len(found.level))


def through(image: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """[h, w] convolved with an odd kernel down the rows and another along them; 0 outside.

    Kernels may have tangents (forward mode); the image may not.
    """
    assert forward_ad.unpack_dual(image).tangent is None
    out: torch.Tensor = _Through.apply(image, rows, columns)
    return out


class _Through(torch.autograd.Function):
    """By OpenCV: a sum of shifted images, torch's convolution of float64 still more, is slower."""

    @staticmethod
    def forward(image: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        return _convolved(image, rows, columns)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        ctx.save_for_forward(*inputs)

    @staticmethod
    def jvp(ctx: Any, *tangents: torch.Tensor | None) -> torch.Tensor:
        image, rows, columns = ctx.saved_tensors
        _, of_rows, of_columns = tangents
        out = torch.zeros_like(image)
        if of_rows is not None:
            out = out + _convolved(image, of_rows, columns)
        if of_columns is not None:
            out = out + _convolved(image, rows, of_columns)
        return out


def _convolved(image: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    down, along = rows.detach().numpy(), columns.detach().numpy()
    wide = cv2.sepFilter2D(image.numpy(), -1, along, down, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(wide)


def noise_residuals(
    found: OverTime, speckle: torch.Tensor, per_grey: torch.Tensor, read_e: torch.Tensor,
    moments: torch.Tensor | None = None,
) -> torch.Tensor:  # fmt: skip
    """What the model of noise is off by, in standard errors.

    How strong speckle is in a bin depends on dots that are not known: it may be off by a factor,
    the same for a bin's covariances. The best one is found here, and is a residual itself.

    Args:
        found: of a scene.
        speckle: [B, APART] of the model.
        per_grey: electrons to a grey value.
        read_e: read-out noise, electrons.
        moments: [B, APART] in place of those found.
    """
    strength = speckle[:, 0].detach()
    error = _DOTS_ERROR + _TAILS_ERROR * strength.mean() / strength.clamp_min(1e-30)
    white = found.level / per_grey + (read_e / per_grey) ** 2 + _STEP
    own = torch.zeros_like(speckle)
    own = torch.cat([white[:, None], own[:, 1:]], dim=1)
    rest = torch.einsum(
        "bij,bj->bi", found.root, (found.moments if moments is None else moments) - own
    )
    by_speckle = torch.einsum("bij,bj->bi", found.root, speckle)
    sure = 1 / error**2
    factor = ((rest * by_speckle).sum(1) + sure) / (by_speckle.square().sum(1) + sure)
    left = rest - factor[:, None] * by_speckle
    out = torch.cat([left, ((factor - 1) / error)[:, None]], dim=1)
    return out[found.known].flatten()
