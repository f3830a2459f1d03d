"""The kernels of `qs3.kernels.linear_max`. Imported where Triton is, and there is a GPU.

Each function takes and gives what the operation of its name there does, in float32.
"""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl

from qs3.kernels.device import ROWS

_CHANNELS = 32  # of a program
_OF_A_POINT = 512  # channels of a program that goes over a point's maxima, of which most have few


@triton.jit
@no_type_check
def _points(
    grad, weight, beside, first, order, out, n, c, d, wide,
    CHANNELS: tl.constexpr,
):  # fmt: skip
    """One point and some channels of it a program: over the maxima that it has."""
    row = tl.program_id(0)
    cloud = row // n
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_channel = channel < c
    begin = tl.load(first + row + cloud).to(tl.int32)  # a cloud has one more than points
    end = tl.load(first + row + cloud + 1).to(tl.int32)
    whole = tl.load(beside + cloud * c + channel, mask=a_channel, other=0.0) / n
    for place in range(begin, end):
        which = tl.load(order + cloud * d + place)
        g = tl.load(grad + cloud * wide + which)
        whole += g * tl.load(weight + which * c + channel, mask=a_channel, other=0.0)
    tl.store(out + row.to(tl.int64) * c + channel, whole, mask=a_channel)


@no_type_check
def points_gradient(grad, weight, beside, first, order):
    """The gradient of the points."""
    (d, c), (b, wide), n = weight.shape, grad.shape, first.shape[1] - 1
    out = weight.new_empty(b, n, c)
    channels = min(_OF_A_POINT, triton.next_power_of_2(c))
    with torch.cuda.device_of(weight):
        _points[b * n, triton.cdiv(c, channels)](
            grad, weight, beside, first, order, out, n, c, d, wide, CHANNELS=channels, num_warps=1
        )
    return out


@triton.jit
@no_type_check
def _weights(
    grad, x, where, base, out, b, n, c, d, wide,
    ROWS: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    """Some rows and columns of W a program: over the clouds."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_row = row < d
    here = a_row[:, None] & (channel < c)[None, :]
    place = row[:, None] * c + channel[None, :]
    whole = tl.load(base + place, mask=here, other=0.0)
    for i in range(b):
        g = tl.load(grad + i * wide + row, mask=a_row, other=0.0)
        at = tl.load(where + i * d + row, mask=a_row, other=0)
        points = (i * n + at)[:, None] * c + channel[None, :]
        whole += g[:, None] * tl.load(x + points, mask=here, other=0.0)
    tl.store(out + place, whole, mask=here)


@no_type_check
def weight_gradient(grad, x, where, base):
    """The gradient of W."""
    (b, n, c), d = x.shape, len(base)
    out = torch.empty_like(base)
    with torch.cuda.device_of(x):
        _weights[triton.cdiv(d, ROWS), triton.cdiv(c, _CHANNELS)](
            grad, x, where, base, out, b, n, c, d, grad.shape[1],
            ROWS=ROWS, CHANNELS=_CHANNELS, num_warps=4,
        )  # fmt: skip
    return out
