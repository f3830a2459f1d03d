"""A split's clouds as training may see them: with labels, or without any that it could reach.

Labels have owners. `Labelled` clouds may be trained on; `Unlabelled` ones have no labels to give.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_cache import prepare
from qs3.errors import ConfigError
from qs3.store.store import PointSet, evenly


@dataclass(frozen=True, eq=False)
class Unlabelled:
    """n clouds with their ids."""

    clouds: Clouds
    ids: tuple[str, ...]

    @property
    def points(self) -> Float[Tensor, "n m 3"]:
        """The clouds in memory as evaluation sees them; made anew each time."""
        return self.clouds.all()


@dataclass(frozen=True, eq=False)
class Labelled:
    """n clouds with their ids and labels [n] int64."""

    clouds: Clouds
    ids: tuple[str, ...]
    labels: Int[Tensor, " n"]

    def at(self, index: np.ndarray) -> Labelled:
        """A part."""
        ids = tuple(self.ids[i] for i in index)
        return Labelled(self.clouds.at(index), ids, self.labels[torch.from_numpy(index)])


def load_clouds(
    dataset: PointSet,
    split: str,
    points: int,
    starts: int = 1,
    cache_dir: Path | None = None,
    *,
    scale: str,
) -> Unlabelled:
    """A split's clouds, prepared (see `prepare`), without their labels.

    `scale` has no default: who forgot it would show a net clouds of another size, and no error.

    Raises:
        ConfigError: heights above a floor are asked for, and nobody knows where it is.
    """
    if scale == "above_floor" and dataset.floor_m is None:
        raise ConfigError(
            f"{dataset.name}: nobody knows where the floor is (floor_m of its domain)"
        )
    part = dataset.split(split)
    key = f"{dataset.name}-{dataset.sha256[:16]}-{split}"
    clouds = prepare(
        part.points,
        points,
        starts=starts,
        cache_dir=cache_dir,
        key=key,
        scale=scale,
        floor=dataset.floor_m or 0.0,
    )
    return Unlabelled(clouds, part.ids)


def labels_of(dataset: PointSet, split: str) -> Int[Tensor, " n"] | None:
    """A split's labels, for those who may have them; None if the dataset has none."""
    if not dataset.labelled:
        return None
    return torch.from_numpy(np.array(dataset.labels[dataset.indices(split)]))


def subsample_splits(dataset: PointSet, count: int) -> PointSet:
    """At most `count` clouds of each split, at even steps; for `debug=fast`.

    They keep their order and ids, and the hash is still that of the whole dataset.
    """
    chosen: list[int] = []
    for split in dataset.counts():
        chosen += evenly(dataset.indices(split), count)
    return dataset.at(np.sort(chosen))


def first_of_class(
    index: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"], count: int
) -> Int[np.ndarray, " k"]:
    """Of some positions in `labels` the first `count` of each class; for `debug=overfit`."""
    left = [np.flatnonzero(labels[index] == k)[:count] for k in np.unique(labels[index])]
    return index[np.sort(np.concatenate(left))]
