"""Neighbours of points: kNN, farthest points, gathering. Batched plain torch.

Written here because torch-cluster is deprecated and pyg-lib is not on PyPI.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.kernels import compiled
from qs3.kernels.device import exact_products, exporting, takes_numpy, takes_triton
from qs3.kernels.matmul import matmul_t
from qs3.kernels.points import farthest_points, farthest_points_by_scan, smallest_sums

_BLOCK = 1 << 26  # distances held at once: 256 MB in float32
_CPU_BLOCK = 1 << 20  # 4 MB, to stay near the caches
_TREE_FROM = 1536  # points in 3D, from which a KD-tree is faster than all distances


def knn(x: Float[Tensor, "b n c"], k: int) -> Int[Tensor, "b n k"]:
    """Indices of the k nearest points of the same cloud, nearest first, itself included.

    Squared Euclidean distances in the dtype of `x` (float32 at least, also under autocast,
    because in half precision they lose neighbours), about each cloud's mean, so that a cloud
    far from the origin loses nothing. Points at equal distance come in any order. With k > n
    the list of n neighbours starts over from the nearest one.
    """
    n = x.shape[1]
    if k > n:
        return knn(x, n)[:, :, torch.arange(k, device=x.device) % n]
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False), exact_products():
        if x.dtype in (torch.float16, torch.bfloat16):
            x = x.float()
        if takes_numpy(x) and x.shape[2] == 3 and n >= _TREE_FROM:
            return _knn_tree(x, k)
        return _knn_dense(x - x.mean(dim=1, keepdim=True), k)


def _knn_tree(x: Tensor, k: int) -> Tensor:
    ranks, workers = list(range(1, k + 1)), torch.get_num_threads()
    found = [cKDTree(cloud).query(cloud, ranks, workers=workers)[1] for cloud in x.numpy()]
    return torch.from_numpy(np.stack(found).astype(np.int64))


def _knn_dense(x: Tensor, k: int) -> Tensor:
    """Distances by |x_j|^2 - 2 x_i x_j (|x_i|^2 does not change the order within a row)."""
    b, n, _ = x.shape
    squares = x.square().sum(2)[:, None]  # [b, 1, n]
    scaled = -2 * x
    if exporting():  # blocks would bind the graph to a number of clouds
        return _smallest(x @ scaled.transpose(1, 2) + squares, k)
    on_cpu = takes_numpy(x)
    block = _CPU_BLOCK if on_cpu else _BLOCK
    added = on_cpu and n >= 3 * compiled.groups_for(k)
    rows = max(1, min(n, block // n))
    clouds = max(1, block // (n * rows))
    out = torch.empty(b, n, k, dtype=torch.int64, device=x.device)
    for i in range(0, b, clouds):
        c = slice(i, i + clouds)
        for j in range(0, n, rows):
            part = out[c, j : j + rows]
            if clouds == 1:
                product = matmul_t(x[i, j : j + rows], scaled[i])[None]
            else:
                product = x[c, j : j + rows] @ scaled[c].transpose(1, 2)
            if takes_triton(x):
                found = smallest_sums(product, squares[c, 0], k)
            elif added:
                found = compiled.smallest_sums(product.view(-1, n), squares[c, 0], k)
            else:
                found = _smallest(product.add_(squares[c]).view(-1, n), k)
            part.copy_(found.view(part.shape))
    return out


def _smallest(values: Tensor, k: int) -> Tensor:
    """Columns of the k smallest values of each row, smallest first: [..., n] -> [..., k]."""
    return values.topk(k, largest=False)[1]


def gather(x: Tensor, index: Int[Tensor, "b ..."]) -> Tensor:
    """Rows of each cloud: x [b, n, c], index [b, *rest] -> [b, *rest, c]."""
    flat = index.flatten(1)  # [b, r]
    if not takes_numpy(x):
        # Runtimes take whole rows several times faster than value after value, and a device that
        # must add up in order (`deterministic`) sorts the rows' numbers for it, not the values'.
        first = x.shape[1] * torch.arange(x.shape[0], device=x.device)
        rows = x.flatten(0, 1).index_select(0, (flat + first[:, None]).flatten())
        return rows.view(*index.shape, x.shape[2])
    rows = torch.gather(x, 1, flat[:, :, None].expand(-1, -1, x.shape[2]))
    return rows.view(*index.shape, x.shape[2])


def farthest_point_sampling(
    x: Float[Tensor, "b n 3"], n: int, start: Int[Tensor, " b"] | int = 0
) -> Int[Tensor, "b m"]:
    """Order in which farthest point sampling takes the first `n` points, from `start`.

    Exact; which of several equally far points comes first is unspecified (elsewhere than on the
    CPU the lowest index). Indices are distinct, copies of taken points come last. With n > N the
    order of all N points starts over.
    """
    if not takes_numpy(x):
        b, total, _ = x.shape
        if n > total:
            index = torch.arange(n, device=x.device) % total
            return farthest_point_sampling(x, total, start)[:, index]
        x = x.detach().float()
        x = x - x.mean(dim=1, keepdim=True)
        if not isinstance(start, Tensor):
            start = torch.full((b,), start, device=x.device)
        return farthest_points_by_scan(x, n, start) if exporting() else farthest_points(x, n, start)
    starts = torch.as_tensor(start).expand(len(x)).tolist()
    clouds = zip(x.detach().float().numpy(), starts, strict=True)
    orders = [farthest_point_sampling_np(cloud, n, first) for cloud, first in clouds]
    return torch.from_numpy(np.stack(orders))
