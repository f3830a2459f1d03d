"""Batches drawn from clouds, in an order that is a function of (seed, epoch).

It has no worker processes: a batch is one indexing into mapped files, and augmentation happens
on the device. So there is nothing that the number of workers could change.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from qs3.datamodules.clouds import Clouds, Labelled
from qs3.utils.seeding import derive


def balanced(classes: Int[Tensor, " n"], generator: torch.Generator) -> Int[Tensor, " n"]:
    """As many positions, each of a class drawn at random: all that occur are equally likely.

    A class's clouds come in a shuffled order, again and again: none comes twice before all have
    come once. So a rare class repeats its clouds, and some of a common one do not come at all.
    """
    present, of = classes.unique(return_inverse=True)
    drawn = torch.randint(len(present), (len(classes),), generator=generator)
    order = torch.empty_like(drawn)
    for k in range(len(present)):
        places, members = (drawn == k).nonzero()[:, 0], (of == k).nonzero()[:, 0]
        while len(places):
            members = members[torch.randperm(len(members), generator=generator)]
            order[places[: len(members)]] = members[: len(places)]
            places = places[len(members) :]
    return order


class Piece(NamedTuple):
    """An epoch that is not one pass over the data but a piece of a longer way through them.

    Batches `first` to `stop`, counted from the way's beginning; phases take different ways.
    """

    way: int
    first: int
    stop: int


class Batches:
    """One epoch: `{"source": {"points", "y_source"}, ..., "index": i, "epoch": e}` per step.

    Each cloud is seen in one of its samples, drawn anew each epoch.

    Args:
        parts: by domain; the first decides the number of batches, the others are drawn from
            again and again, each time in a new order. Labels stand under their owner's name.
        batch_size: clouds of each domain in a batch. A last batch of one cloud (batch
            normalisation cannot use it) joins the one before.
        seed, epoch: of the run, and counted from 0.
        shuffle: False keeps the clouds' order, and each cloud's sample 0 (evaluation).
        rank, world: of `world` processes each takes every `world`-th cloud, as many as the others.
        piece: instead of one pass these batches, all of `batch_size`. Each cloud still comes once
            before any comes again.
        pinned: lay batches where an NVIDIA GPU reads them by itself, while the CPU goes on.
    """

    def __init__(
        self,
        parts: Mapping[str, Clouds | Labelled],
        batch_size: int,
        *,
        seed: int,
        epoch: int,
        shuffle: bool = True,
        rank: int = 0,
        world: int = 1,
        piece: Piece | None = None,
        pinned: bool = False,
    ) -> None:
        self.parts = dict(parts)
        self.seed, self.epoch, self.shuffle = seed, epoch, shuffle
        self.rank, self.world = rank, world
        self.piece, self.pinned = piece, pinned
        first = next(iter(self.parts.values()))
        if piece is None:
            n = -(-len(first) // world)
            self.sizes = [min(batch_size, n - i) for i in range(0, n, batch_size)]
            if n % batch_size == 1 and n > 1:
                self.sizes[-2:] = [batch_size + 1]
        else:
            self.sizes = [batch_size] * (piece.stop - piece.first)

    def __len__(self) -> int:
        return len(self.sizes)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        by_name = {name: self._batches(name, part) for name, part in self.parts.items()}
        for i in range(len(self)):
            batch: dict[str, Any] = {"index": i, "epoch": self.epoch}
            for name, batches in by_name.items():
                rows = next(batches)
                batch[name] = {k: x.pin_memory() for k, x in rows.items()} if self.pinned else rows
            yield batch

    def _batches(self, name: str, part: Clouds | Labelled) -> Iterator[dict[str, Tensor]]:
        clouds = part if isinstance(part, Clouds) else part.clouds
        index = self._order(name, part)
        starts = None
        if self.shuffle and clouds.starts > 1:
            chance = self._generator("sample", name, self.epoch)
            starts = torch.randint(clouds.starts, (len(clouds),), generator=chance)
        for rows in index.split(self.sizes):
            batch = {"points": clouds.take(rows, None if starts is None else starts[rows])}
            if isinstance(part, Labelled):
                batch[part.owner] = part.labels[rows]
            yield batch

    def _order(self, name: str, part: Clouds | Labelled) -> Tensor:
        """This process's positions of the epoch: its share of one order after another."""
        n, needed = len(part), sum(self.sizes)
        each = -(-n // self.world)  # all processes take equally many: some clouds come twice
        begin = 0 if self.piece is None else self.piece.first * self.sizes[0]
        way: tuple[int | str, ...] = (self.epoch,)
        if self.piece is not None:
            way = ("way", self.piece.way)
        shares = []
        for passed in range(begin // each, -(-(begin + needed) // each)):
            generator = self._generator("shuffle", name, *way, passed)
            if not self.shuffle:
                order = torch.arange(n)
            elif isinstance(part, Labelled) and part.balanced:
                order = balanced(part.labels, generator)
            else:
                order = torch.randperm(n, generator=generator)
            shares.append(
                order.repeat(1 + self.world)[: each * self.world][self.rank :: self.world]
            )
        return torch.cat(shares)[begin % each :][:needed]

    def _generator(self, *names: int | str) -> torch.Generator:
        return torch.Generator().manual_seed(derive(self.seed, *names))


def generator_of(
    batch: Mapping[str, Any], use: str, seed: int, rank: int, device: Any
) -> torch.Generator:
    """Randomness of one use in one step: a function of (seed, use, epoch, step, process)."""
    names = (use, batch["epoch"], batch["index"], rank)
    return torch.Generator(device=device).manual_seed(derive(seed, *names))
