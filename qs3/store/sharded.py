"""One array of clouds that lies in several files, for datasets that are larger than one should be.

It answers to what the rest asks of a numpy array: its shape, clouds by number, a batch by numbers.
Only what is asked for is read. A part of it (a slice, `at`) copies nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import EllipsisType, NoneType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_PLAIN = (slice, int, np.integer, EllipsisType, NoneType)
"""What a place of a key may be where numpy pairs no arrays."""


class ShardedArray:
    """[N, P, C] float32 in shards that lie one behind the other along N; read only.

    Args:
        shards: [n_i, P, C] each, e.g. memmaps; all have as many clouds but the last, which may
            have fewer.
        rows: [N] which clouds of the shards these are, counted through; None: all, in order.
    """

    dtype = np.dtype("<f4")
    ndim = 3

    def __init__(self, shards: Sequence[np.ndarray], rows: np.ndarray | None = None) -> None:
        self._shards = [np.asarray(shard) for shard in shards]
        self._each = len(self._shards[0])
        self._rows = np.arange(sum(map(len, self._shards))) if rows is None else rows

    @property
    def shape(self) -> tuple[int, int, int]:
        """(N, P, C)."""
        _, points, columns = self._shards[0].shape
        return len(self._rows), points, columns

    def __len__(self) -> int:
        """N."""
        return len(self._rows)

    def __iter__(self) -> Iterator[np.ndarray]:
        """The clouds [P, C], one after the other."""
        for i in range(len(self)):
            yield self[i]

    def at(self, rows: slice | np.ndarray) -> ShardedArray:
        """Some clouds, by their positions or by a mask; nothing is read."""
        return ShardedArray(self._shards, self._rows[rows])

    def __getitem__(self, key: Any) -> Any:
        """As of a numpy array: `[i]` [P, C], `[numbers]` [n, P, C] and `[numbers, ...]` a copy.

        But a slice `[a:b]` is another such array, of which nothing has been read. Behind the first
        place slices and numbers read what they name; arrays read the chosen clouds whole first.
        """
        first, *rest = key if isinstance(key, tuple) else (key,)
        if first is Ellipsis:  # as many whole axes as are not named
            missing = self.ndim - sum(one is not None for one in rest)
            return self[(*(slice(None),) * missing, *rest)]
        plain = all(isinstance(one, _PLAIN) for one in rest)
        if isinstance(first, slice):
            part = self.at(first)
            if not rest:
                return part
            if not plain:  # beside the slice, not paired with its numbers
                return np.asarray(part)[(slice(None), *rest)]
            return part[(np.arange(len(part)), *rest)]
        if np.ndim(first) == 0:
            row = int(self._rows[first])
            cloud = self._shards[row // self._each][row % self._each]
            if not plain:  # a number beside arrays is one of them
                return cloud[None][(0, *rest)]
            return cloud[tuple(rest)] if rest else cloud
        rows = self._rows[np.asarray(first)]
        if not plain:  # paired: a shard's part of the first would not fit the others
            whole = self._gathered(rows.ravel(), lambda shard, own, _: shard[own])
            return whole[(np.arange(rows.size).reshape(rows.shape), *rest)]
        return self._gathered(rows, lambda shard, own, _: shard[(own, *rest)])

    def pick(
        self, clouds: Int[np.ndarray, " b"], points: Int[np.ndarray, "b m"]
    ) -> Float[np.ndarray, "b m c"]:
        """Of each of these clouds some points, by their positions in it; a copy."""
        return self._gathered(
            self._rows[clouds], lambda shard, own, where: picked(shard, own, points[where])
        )

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """All clouds in memory: what `np.asarray` gives."""
        del copy  # it is one in any case
        whole = self._gathered(self._rows, lambda shard, own, _: shard[own])
        return whole if dtype is None else whole.astype(dtype, copy=False)

    def _gathered(self, rows: np.ndarray, read: Any) -> np.ndarray:
        """What `read(shard, own rows, their places in `rows`)` gives of each shard, in order."""
        of, own = np.divmod(rows, self._each)
        touched = np.unique(of)
        if len(touched) == 1:
            return np.asarray(read(self._shards[touched[0]], own, slice(None)))
        if len(touched) == 0:
            return np.asarray(read(self._shards[0], own, slice(None)))
        out = None
        for shard in touched:
            where = np.flatnonzero(of == shard)
            part = read(self._shards[shard], own[where], where)
            if out is None:
                out = np.empty((len(rows), *part.shape[1:]), dtype=part.dtype)
            out[where] = part
        assert out is not None
        return out


def picked(
    stored: Float[np.ndarray, "n p c"],
    clouds: Int[np.ndarray, " b"],
    points: Int[np.ndarray, "b m"],
) -> Float[np.ndarray, "b m c"]:
    """Of some clouds some points each, by their positions; a copy.

    Twice as fast as indexing by both: one table with a row a point, and one number for each.
    """
    _, p, columns = stored.shape
    flat = stored.reshape(-1, columns)  # a view
    return np.asarray(flat.take(points + clouds[:, None] * p, axis=0))
