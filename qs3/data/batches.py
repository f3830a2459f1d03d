"""Batches drawn from tables in memory, in an order that is a function of (seed, epoch).

There are no worker processes: clouds lie in memory, a batch is one indexing, and augmentation
happens on the device. So there is nothing that the number of workers could change.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from qs3.randomness import derive


@dataclass(frozen=True, eq=False)
class Table:
    """Clouds of one domain, with labels under the name of their owner, or without any.

    Attributes:
        points: [n, p, 3] float32.
        labels: by owner ("y_source", "y_pseudo", "y_target_train"): [n] int64; often none at all.
    """

    points: Tensor
    labels: Mapping[str, Tensor]

    def __len__(self) -> int:
        return len(self.points)

    def rows(self, index: Tensor) -> dict[str, Tensor]:
        """The clouds (key "points") and labels at `index`."""
        return {"points": self.points[index], **{k: y[index] for k, y in self.labels.items()}}


class Batches:
    """One epoch: `{"source": {"points", "y_source"}, ..., "index": i, "epoch": e}` per step.

    Args:
        tables: by domain; the first decides the number of batches, the others are drawn from
            again and again, each time in a new order.
        batch_size: clouds of each domain in a batch. A last batch of one cloud (batch
            normalisation cannot use it) joins the one before.
        seed: of the run.
        epoch: counted from 0.
        shuffle: False keeps the tables' order (evaluation).
        rank: of this process; each takes every `world`-th cloud, and as many as the others.
        world: number of processes.
    """

    def __init__(
        self,
        tables: Mapping[str, Table],
        batch_size: int,
        *,
        seed: int,
        epoch: int,
        shuffle: bool = True,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self.tables = dict(tables)
        self.seed, self.epoch, self.shuffle = seed, epoch, shuffle
        self.rank, self.world = rank, world
        first = next(iter(self.tables.values()))
        self.sizes = _sizes(-(-len(first) // world), batch_size)

    def __len__(self) -> int:
        return len(self.sizes)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        orders = {name: self._order(name, len(table)) for name, table in self.tables.items()}
        for i, size in enumerate(self.sizes):
            batch: dict[str, Any] = {"index": i, "epoch": self.epoch}
            for name, table in self.tables.items():
                batch[name] = table.rows(torch.tensor([next(orders[name]) for _ in range(size)]))
            yield batch

    def _order(self, name: str, n: int) -> Iterator[int]:
        """Endless positions in 0..n-1, this process's share of one permutation after another."""
        passed = 0
        while True:
            if self.shuffle:
                generator = torch.Generator().manual_seed(
                    derive(self.seed, "shuffle", name, self.epoch, passed)
                )
                order = torch.randperm(n, generator=generator).tolist()
            else:
                order = list(range(n))
            padded = order + order[: -n % self.world]  # all processes take equally many
            yield from padded[self.rank :: self.world]
            passed += 1


def generator_of(
    batch: Mapping[str, Any], use: str, seed: int, rank: int, device: Any
) -> torch.Generator:
    """Randomness of one use in one step: a function of (seed, use, epoch, step, process)."""
    names = (use, batch["epoch"], batch["index"], rank)
    return torch.Generator(device=device).manual_seed(derive(seed, *names))


def _sizes(n: int, batch_size: int) -> list[int]:
    """Sizes of the batches that n clouds are cut into."""
    sizes = [batch_size] * (n // batch_size)
    if rest := n % batch_size:
        if rest == 1 and sizes:
            sizes[-1] += 1
        else:
            sizes.append(rest)
    return sizes
