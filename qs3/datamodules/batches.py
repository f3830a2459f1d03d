"""Batches drawn from tables, in an order that is a function of (seed, epoch).

There are no worker processes: a batch is one indexing into mapped files, and augmentation happens
on the device. So there is nothing that the number of workers could change.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.random_views import RandomViews
from qs3.utils.seeding import derive


@dataclass(frozen=True, eq=False)
class Table:
    """Clouds of one domain, with labels under the name of their owner, or without any.

    Attributes:
        clouds: n clouds.
        labels: by owner ("y_source", "y_pseudo", "y_target_train"): [n] int64; often none at all.
        balance: the owner whose classes are drawn equally often; None draws each cloud once.
        beside: further clouds of the same objects, by their key in a batch (see
            `qs3.datamodules.twins`); under "points" what comes in place of `clouds`.
        repeated: further keys under which a batch has the very clouds of "points".
    """

    clouds: Clouds
    labels: Mapping[str, Tensor]
    balance: str | None = None
    beside: Mapping[str, Clouds | RandomViews] = field(default_factory=dict)
    repeated: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.clouds)

    def rows(self, index: Tensor, draws: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
        """The clouds (key "points") and labels at `index`, and what is beside them.

        `draws`: by key what was drawn for these rows (`draw` of the clouds).
        """
        labels = {key: y[index] for key, y in self.labels.items()}
        found = {key: some.take(index, draws.get(key)) for key, some in self.sources.items()}
        return {**found, **{key: found["points"] for key in self.repeated}, **labels}

    @property
    def sources(self) -> dict[str, Any]:
        """Where the clouds of each key come from, "points" first."""
        return {"points": self.clouds, **self.beside}

    def order(self, generator: torch.Generator) -> Int[Tensor, " n"]:
        """As many positions as clouds: all of them, shuffled; or `balanced`."""
        if self.balance is None:
            return torch.randperm(len(self), generator=generator)
        return balanced(self.labels[self.balance], generator)


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


@dataclass(frozen=True)
class Piece:
    """An epoch that is not one pass over the data but a piece of a longer way through them.

    Attributes:
        way: which one; two phases of a run take different ways.
        first, stop: its batches, counted from the way's beginning.
    """

    way: int
    first: int
    stop: int


class Batches:
    """One epoch: `{"source": {"points", "y_source"}, ..., "index": i, "epoch": e}` per step.

    Each cloud is seen in one of its samples, drawn anew each epoch.

    Args:
        tables: by domain; the first decides the number of batches, the others are drawn from
            again and again, each time in a new order.
        batch_size: clouds of each domain in a batch. A last batch of one cloud (batch
            normalisation cannot use it) joins the one before.
        seed, epoch: of the run, and counted from 0.
        shuffle: False keeps the tables' order, and each cloud's sample 0 (evaluation).
        rank, world: of `world` processes each takes every `world`-th cloud, as many as the others.
        piece: instead of one pass these batches, all of `batch_size`. Each cloud still comes once
            before any comes again.
        pinned: lay batches where an NVIDIA GPU reads them by itself, while the CPU goes on.
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
        piece: Piece | None = None,
        pinned: bool = False,
    ) -> None:
        self.tables = dict(tables)
        self.seed, self.epoch, self.shuffle = seed, epoch, shuffle
        self.rank, self.world = rank, world
        self.piece, self.pinned = piece, pinned
        first = next(iter(self.tables.values()))
        if piece is None:
            self.sizes = _sizes(-(-len(first) // world), batch_size)
        else:
            self.sizes = [batch_size] * (piece.stop - piece.first)

    def __len__(self) -> int:
        return len(self.sizes)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        parts = {name: self._parts(name, table) for name, table in self.tables.items()}
        for i in range(len(self)):
            batch: dict[str, Any] = {"index": i, "epoch": self.epoch}
            for name, table in self.tables.items():
                index, draws = parts[name]
                rows = table.rows(index[i], {key: some[i] for key, some in draws.items()})
                batch[name] = {k: x.pin_memory() for k, x in rows.items()} if self.pinned else rows
            yield batch

    def _parts(
        self, name: str, table: Table
    ) -> tuple[tuple[Tensor, ...], dict[str, tuple[Tensor, ...]]]:
        """Positions [size] of each batch, and while training by key what is drawn for them."""
        index = self._order(name, table)
        draws = {}
        if self.shuffle:
            for key, clouds in table.sources.items():
                use = (name,) if key == "points" else (name, key)
                drawn = clouds.draw(len(table), self._generator("sample", *use, self.epoch))
                if drawn is not None:
                    draws[key] = drawn[index].split(self.sizes)
        return index.split(self.sizes), draws

    def _order(self, name: str, table: Table) -> Tensor:
        """This process's positions of the epoch: its share of one order after another."""
        n, needed = len(table), sum(self.sizes)
        each = -(-n // self.world)  # all processes take equally many: some clouds come twice
        begin = 0 if self.piece is None else self.piece.first * self.sizes[0]
        way: tuple[int | str, ...] = (self.epoch,)
        if self.piece is not None:
            way = ("way", self.piece.way)
        shares = []
        for passed in range(begin // each, -(-(begin + needed) // each)):
            if self.shuffle:
                order = table.order(self._generator("shuffle", name, *way, passed))
            else:
                order = torch.arange(n)
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


def _sizes(n: int, batch_size: int) -> list[int]:
    """Sizes of the batches that n clouds are cut into."""
    sizes = [batch_size] * (n // batch_size)
    if rest := n % batch_size:
        if rest == 1 and sizes:
            sizes[-1] += 1
        else:
            sizes.append(rest)
    return sizes
