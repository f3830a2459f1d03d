"""EdgeConv along its edges, nearest neighbours, and maxima of linear layers backwards, compiled.

By torch's operations the gathered rows are written and read again, k times the size of the result;
here it is one loop. For float32 and float64 on the CPU; elsewhere callers go by torch's operations.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor

_ALONE = 1 << 16  # values that are too few to be shared by threads
_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}


@torch.compiler.disable
def neighbour_max(x: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum [q, c] over each row's neighbours index [q, k] in x [p, c]; NaN is above all.

    And int32 [q, c]: the first of its neighbours that has it (of NaN: one that is).
    """
    best = x.new_empty(len(index), x.shape[1])
    where = torch.empty(best.shape, dtype=torch.int32)
    _shared("neighbour_max", len(index), best.numel(), x, index, best, where)
    return best, where


@torch.compiler.disable
def neighbour_max_backward(grad: Tensor, where: Tensor, points: int) -> Tensor:
    """The gradient [points, c] of `x`, from that of the maxima [q, c] and their rows."""
    out = grad.new_zeros(points, grad.shape[1])
    _shared("add_where", grad.shape[1], grad.numel(), grad, where, out)
    return out


@torch.compiler.disable
def add_to_neighbours(x: Tensor, index: Tensor) -> Tensor:
    """A'x: each row of x [q, c] added to the rows that index [q, k] names, [q, c]."""
    out = x.new_zeros(x.shape)
    _shared("add_to_neighbours", x.shape[1], index.numel() * x.shape[1], x, index, out)
    return out


@torch.compiler.disable
def linear_max_backward(
    x: Tensor, weight: Tensor, grad: Tensor, where: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of x [b, n, c] and W [d, c] of the maximum of x W' over the rows of each cloud.

    From that of the maxima [b, d], and the rows of their clouds that have them, [b, d] int64.
    """
    dx, dweight = x.new_zeros(x.shape), weight.new_zeros(weight.shape)
    values = grad.numel() * x.shape[2]
    _shared("add_products", x.shape[2], values, x, weight, grad, where, dx, dweight)
    return dx, dweight


@torch.compiler.disable
def smallest_sums(values: Tensor, more: Tensor, k: int) -> Tensor:
    """Columns of the k smallest values of each row after `more` was added to them, smallest first.

    Columns are dealt to groups; everything above the k-th smallest of the groups' minima is out,
    which leaves hardly more than k to be sorted. Of equal values the first columns come first.

    Args:
        values: [r, n] contiguous; the sums afterwards.
        more: [c, n], of the first r / c rows, the next ones, ...
        k: at most `n`; the result is int64 [r, k].
    """
    (r, n), groups = values.shape, groups_for(k)
    minima = values.new_empty(r, groups)
    _shared("add_and_minima", r, values.numel(), values, more, minima)
    bound = _kth_smallest(minima, k)
    count = torch.empty(r, dtype=torch.int64)
    for places in (2 * k + 8, n):  # where many values are equal more of them may be in
        few = values.new_empty(r, places + groups)
        column = torch.empty(few.shape, dtype=torch.int32)
        _shared("collect_below", r, values.numel(), values, minima, bound, few, column, count)
        if int(count.max()) <= places:
            break
    out = torch.empty(r, k, dtype=torch.int64)
    _shared("take_in_order", r, values.numel(), few, column, count, out)
    return out


def _kth_smallest(x: Tensor, k: int) -> Tensor:
    """The k-th smallest of each row of x [r, n], [r]; NaN is above all."""
    kind, infinite = _BITS[x.dtype], torch.tensor(torch.inf, dtype=x.dtype)
    top = torch.iinfo(kind).max
    limits = torch.tensor([top, int(infinite.view(kind)), k], dtype=kind)
    bound = x.new_empty(len(x))
    _shared("kth_smallest", len(x), x.numel(), x.view(kind), limits, bound.view(kind))
    return bound


def groups_for(k: int) -> int:
    """To how many groups columns are dealt, so that hardly more than k values have to be sorted."""
    return 64 * -(-k // 32)


def _shared(kernel: str, size: int, values: int, *tensors: Tensor) -> None:
    """Call a kernel on parts of its range, one for each of torch's threads."""
    from qs3.kernels import numba_kernels

    run: Callable[..., None] = getattr(numba_kernels, kernel)
    arrays = [one.detach().contiguous().numpy() for one in tensors]  # results are contiguous
    parts = 1 if values < _ALONE else min(torch.get_num_threads(), size)
    ends = [size * i // parts for i in range(parts + 1)]
    if parts == 1:
        run(*arrays, 0, size)
        return
    threads = _threads(parts, os.getpid())
    jobs = [threads.submit(run, *arrays, *part) for part in pairwise(ends)]
    for job in jobs:
        job.result()


@cache
def _threads(number: int, process: int) -> ThreadPoolExecutor:
    """Threads of this process: a fork has none of its parent's."""
    return ThreadPoolExecutor(number, thread_name_prefix="qs3-kernels")
