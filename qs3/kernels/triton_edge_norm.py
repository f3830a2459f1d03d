"""The kernels of `qs3.kernels.edge_norm`. Imported where Triton is, and there is a GPU.

Each function takes and gives, in float32, what the operation of its name there does.
"""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl

from qs3.kernels.device import ROWS

_CHANNELS = 64  # of a program
_FEW_CHANNELS = 32  # of one whose points take their neighbours' from the cache
_EDGES = 4  # at a time, of a program that goes over them


@triton.jit
@no_type_check
def _extremes(
    pr, index, gamma, pivot, best_out, taken_out, sums_out, own_out, parts_out, rows, d, k,
    ROWS: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    """Some points and channels a program; what their neighbours have comes from the cache."""
    block = tl.program_id(0).to(tl.int64)
    row = block * ROWS + tl.arange(0, ROWS)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_row, a_channel = row < rows, channel < d
    here = a_row[:, None] & a_channel[None, :]
    place = row[:, None] * d + channel[None, :]
    wide = row[:, None] * (2 * d) + channel[None, :]
    own = tl.load(pr + wide + d, mask=here, other=0.0) - tl.load(pr + wide, mask=here, other=0.0)
    own -= tl.load(pivot + channel, mask=a_channel, other=0.0)[None, :]
    sign = tl.load(gamma + channel, mask=a_channel, other=0.0)
    sign = tl.where(sign < 0.0, -1.0, 1.0)[None, :]
    best = tl.full([ROWS, CHANNELS], float("-inf"), tl.float32)
    taken = tl.zeros([ROWS, CHANNELS], tl.int32)
    sums = tl.zeros([ROWS, CHANNELS], tl.float32)
    squares = tl.zeros([ROWS, CHANNELS], tl.float32)
    for j in range(k):
        at = tl.load(index + row * k + j, mask=a_row, other=0)
        p = tl.load(pr + at[:, None] * (2 * d) + channel[None, :], mask=here, other=0.0)
        better = p * sign > best
        best = tl.where(better, p * sign, best)
        taken = tl.where(better, j, taken)
        sums += p
        squares += (p + own) * (p + own)
    tl.store(best_out + place, best * sign + own, mask=here)
    tl.store(taken_out + place, taken.to(tl.uint8), mask=here)
    tl.store(sums_out + place, sums, mask=here)
    tl.store(own_out + place, own, mask=here)
    part = parts_out + block * d + channel
    whole = tl.sum(tl.where(here, sums + k * own, 0.0), axis=0)
    tl.store(part, whole, mask=a_channel)
    squares = tl.sum(tl.where(here, squares, 0.0), axis=0)
    tl.store(part + tl.num_programs(0).to(tl.int64) * d, squares, mask=a_channel)


@no_type_check
def edge_extremes(pr, index, gamma, pivot):
    """The extreme edges of each point, and what the statistics of all need."""
    (rows, k), d = index.shape, len(gamma)
    blocks = triton.cdiv(rows, ROWS)
    best, sums, own = pr.new_empty(3, rows, d).unbind(0)
    taken = torch.empty(rows, d, dtype=torch.uint8, device=pr.device)
    parts = pr.new_empty(2, blocks, d)
    with torch.cuda.device_of(pr):
        _extremes[blocks, triton.cdiv(d, _FEW_CHANNELS)](
            pr, index, gamma, pivot, best, taken, sums, own, parts, rows, d, k,
            ROWS=ROWS, CHANNELS=_FEW_CHANNELS, num_warps=4,
        )  # fmt: skip
    return best, taken, sums, own, parts


@triton.jit
@no_type_check
def _output(
    best, sums, pivot, gamma, beta, y_out, t_out, constants, rows, d, edges, eps, slope,
    ROWS: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    """Every program finds its channels' constants; the first ones of each channel keep them."""
    block = tl.program_id(0).to(tl.int64)
    row = block * ROWS + tl.arange(0, ROWS)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_channel = channel < d
    here = (row < rows)[:, None] & a_channel[None, :]
    place = row[:, None] * d + channel[None, :]
    off = tl.load(sums + channel, mask=a_channel, other=0.0) / edges
    var = tl.load(sums + d + channel, mask=a_channel, other=0.0) / edges - off * off
    var = tl.where(var < 0.0, 0.0, var)
    rstd = 1.0 / tl.sqrt(var + eps)
    h = rstd * tl.load(gamma + channel, mask=a_channel, other=0.0)
    shift = tl.load(beta + channel, mask=a_channel, other=0.0)
    t = tl.load(best + place, mask=here, other=0.0) - off[None, :]
    y = h[None, :] * t + shift[None, :]
    tl.store(t_out + place, t, mask=here)
    tl.store(y_out + place, tl.where(y > 0.0, y, slope * y), mask=here)
    keeps = channel < tl.where(block == 0, d, 0)
    mean = off + tl.load(pivot + channel, mask=a_channel, other=0.0)
    tl.store(constants + channel, mean, mask=keeps)
    tl.store(constants + d + channel, var, mask=keeps)
    tl.store(constants + 2 * d + channel, rstd, mask=keeps)
    tl.store(constants + 3 * d + channel, h, mask=keeps)
    tl.store(constants + 4 * d + channel, off, mask=keeps)


@no_type_check
def edge_output(best, sums, pivot, gamma, beta, edges, eps, negative_slope):
    """The layer's output, from the extremes and the sums over all edges."""
    rows, d = best.shape
    y, t = best.new_empty(2, rows, d).unbind(0)
    constants = best.new_empty(5, d)
    with torch.cuda.device_of(best):
        _output[triton.cdiv(rows, ROWS), triton.cdiv(d, _CHANNELS)](
            best, sums, pivot, gamma, beta, y, t, constants, rows, d, edges, eps, negative_slope,
            ROWS=ROWS, CHANNELS=_CHANNELS, num_warps=4,
        )  # fmt: skip
    return y, t, constants


@triton.jit
@no_type_check
def _output_gradient(
    grad, y, t, constants, du_out, parts_out, rows, d, slope,
    ROWS: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    block = tl.program_id(0).to(tl.int64)
    row = block * ROWS + tl.arange(0, ROWS)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_channel = channel < d
    here = (row < rows)[:, None] & a_channel[None, :]
    place = row[:, None] * d + channel[None, :]
    du = tl.load(grad + place, mask=here, other=0.0)
    du = tl.where(tl.load(y + place, mask=here, other=0.0) > 0.0, du, slope * du)
    tl.store(du_out + place, du, mask=here)
    rstd = tl.load(constants + 2 * d + channel, mask=a_channel, other=0.0)
    of_gamma = tl.sum(du * tl.load(t + place, mask=here, other=0.0), axis=0) * rstd
    part = parts_out + block * d + channel
    tl.store(part, tl.sum(du, axis=0), mask=a_channel)
    tl.store(part + tl.num_programs(0).to(tl.int64) * d, of_gamma, mask=a_channel)


@no_type_check
def edge_output_gradient(grad, y, t, constants, negative_slope):
    """The gradient before LeakyReLU, and parts of the norm's."""
    rows, d = y.shape
    blocks = triton.cdiv(rows, ROWS)
    du, parts = torch.empty_like(y), y.new_empty(2, blocks, d)
    with torch.cuda.device_of(y):
        _output_gradient[blocks, triton.cdiv(d, _CHANNELS)](
            grad, y, t, constants, du, parts, rows, d, negative_slope,
            ROWS=ROWS, CHANNELS=_CHANNELS, num_warps=4,
        )  # fmt: skip
    return du, parts


@triton.jit
@no_type_check
def _gradient(
    pr, own, du, taken, sums, first, order, constants, of_norm, out, d, k, edges,
    EDGES: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    """One point and some channels a program: over the edges that lead to it, some at a time."""
    row = tl.program_id(0).to(tl.int64)
    channel = tl.program_id(1) * CHANNELS + tl.arange(0, CHANNELS)
    a_channel = channel < d
    begin = tl.load(first + row).to(tl.int32)
    end = tl.load(first + row + 1).to(tl.int32)
    own_of_edges = tl.zeros([EDGES, CHANNELS], tl.float32)
    du_of_edges = tl.zeros([EDGES, CHANNELS], tl.float32)
    for start in range(begin, end, EDGES):
        place = start + tl.arange(0, EDGES)
        an_edge = place < end
        edge = tl.load(order + place, mask=an_edge, other=0).to(tl.int32)
        source = edge // k
        slot = edge - source * k
        here = an_edge[:, None] & a_channel[None, :]
        at = source.to(tl.int64)[:, None] * d + channel[None, :]
        own_of_edges += tl.load(own + at, mask=here, other=0.0)
        which = tl.load(taken + at, mask=here, other=0).to(tl.int32)
        du_of_edges += tl.load(du + at, mask=here & (which == slot[:, None]), other=0.0)
    rstd = tl.load(constants + 2 * d + channel, mask=a_channel, other=0.0)
    h = tl.load(constants + 3 * d + channel, mask=a_channel, other=0.0)
    off = tl.load(constants + 4 * d + channel, mask=a_channel, other=0.0)
    of_beta = h / edges * tl.load(of_norm + channel, mask=a_channel, other=0.0)
    of_gamma = h / edges * rstd * tl.load(of_norm + d + channel, mask=a_channel, other=0.0)
    place = row * d + channel
    # Edges from this point: z less mean, summed over its neighbours.
    z = tl.load(own + place, mask=a_channel, other=0.0) - off
    z = tl.load(sums + place, mask=a_channel, other=0.0) + k * z
    dq = h * tl.load(du + place, mask=a_channel, other=0.0) - k * of_beta - of_gamma * z
    # Edges to it, over those that name it.
    degree = (end - begin).to(tl.float32)
    p = tl.load(pr + row * (2 * d) + channel, mask=a_channel, other=0.0)
    z = degree * (p - off) + tl.sum(own_of_edges, axis=0)
    dp = h * tl.sum(du_of_edges, axis=0) - degree * of_beta - of_gamma * z
    tl.store(out + row * (2 * d) + channel, dp - dq, mask=a_channel)
    tl.store(out + row * (2 * d) + d + channel, dq, mask=a_channel)


@no_type_check
def edge_gradient(pr, own, du, taken, sums, first, order, constants, of_norm):
    """The gradient of P and R."""
    rows, d = du.shape
    out = torch.empty_like(pr)
    with torch.cuda.device_of(pr):
        _gradient[rows, triton.cdiv(d, _CHANNELS)](
            pr, own, du, taken, sums, first, order, constants, of_norm, out,
            d, len(order) // rows, len(order), EDGES=_EDGES, CHANNELS=_CHANNELS, num_warps=1,
        )  # fmt: skip
    return out
