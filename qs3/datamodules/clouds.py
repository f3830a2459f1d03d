"""Clouds as a net sees them, taken from where they lie on disk: centred, scaled, farthest points.

Nothing is copied until a batch asks for it: the stored clouds stay a memmap, and of the samples
only the indices are kept. Processes that train on the same dataset share both in the page cache.

Labels have owners. `Labelled` clouds may be trained on; `Clouds` have no labels to give.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from qs3.datamodules.fps_samples import farthest_points
from qs3.store.store import HEIGHTS, PointSet


@dataclass(frozen=True, eq=False)
class Clouds:
    """n clouds of m points about their centroid, each in `starts` different samples.

    Attributes:
        stored: [N, P, 3] float32, as published; e.g. a memmap.
        order: [N, starts, m] indices into a stored cloud, each in the order of farthest point
            sampling; None if m = P, where there is nothing to choose.
        centre: [N, 3] float32, a cloud's centroid about its first point.
        radius: [N] float32, largest distance from the centroid; 1 where it is 0.
        rows: [n] which of the N clouds these are.
        scale: "unit_ball": a batch's clouds are divided by their radius; "metres": they are not;
            "above_floor": they are not, and z is the height above the floor, not the centroid;
            "seen": so, and turned about z so that the camera, which is at x = y = 0 of `stored`,
            looks along +y at the centroid.
        floor: z of the floor in `stored`; for "above_floor" and "seen".
        names: ids of all N; empty where there are none.
    """

    stored: Float[np.ndarray, "N P 3"]
    order: Int[np.ndarray, "N s m"] | None
    centre: Float[np.ndarray, "N 3"]
    radius: Float[np.ndarray, " N"]
    rows: Int[np.ndarray, " n"]
    scale: str = "unit_ball"
    floor: float = 0.0
    names: tuple[str, ...] = ()

    @staticmethod
    def of(
        stored: Float[np.ndarray, "n p 3"],
        order: np.ndarray | None = None,
        scale: str = "unit_ball",
        floor: float = 0.0,
        names: tuple[str, ...] = (),
    ) -> Clouds:
        """All of `stored`; its clouds are read once, for their balls (see `geometry.unit_ball`)."""
        centre = np.empty((len(stored), 3), dtype=np.float32)
        radius = np.empty(len(stored), dtype=np.float32)
        for i, cloud in enumerate(np.asarray(stored)):
            moved = cloud - cloud[:1]
            centre[i] = moved.mean(axis=0)
            radius[i] = np.linalg.norm(moved - centre[i], axis=1).max() or 1.0
        return Clouds(stored, order, centre, radius, np.arange(len(stored)), scale, floor, names)

    def __len__(self) -> int:
        """How many there are."""
        return len(self.rows)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of these n clouds."""
        return tuple(self.names[row] for row in self.rows)

    @property
    def starts(self) -> int:
        """Samples to choose from, numbered from 0; number 0 begins at point 0."""
        return 1 if self.order is None else self.order.shape[1]

    def at(self, index: Shaped[np.ndarray, " k"]) -> Clouds:
        """A part of these clouds, by positions or by a mask; nothing is copied."""
        return dataclasses.replace(self, rows=self.rows[index])

    def take(
        self, index: Int[Tensor, " b"], start: Int[Tensor, " b"] | None = None
    ) -> Float[Tensor, "b m 3"]:
        """A batch: the clouds at `index`, each in its sample `start` (None: all in number 0)."""
        rows = self.rows[index.numpy()]  # [B]
        first, centre = self.stored[rows, 0], self.centre[rows]  # [B, 3]
        if self.order is None:
            points = self.stored[rows]  # [B, P, 3], a copy
        else:
            chosen = self.order[rows, 0 if start is None else start.numpy()]  # [B, m]
            # One table with a row a point: twice as fast as indexing by both.
            flat = self.stored.reshape(-1, 3)  # a view
            points = np.asarray(
                flat.take(chosen + rows[:, None] * self.stored.shape[1], axis=0)
            )  # [B, m, 3]
        # In this order, which is `geometry.unit_ball`'s: the same bits as of the whole cloud.
        points -= first[:, None]
        points -= centre[:, None]
        if self.scale == "unit_ball":
            points /= self.radius[rows, None, None]
        elif self.scale in HEIGHTS:
            points[..., 2] += (first + centre)[:, None, 2] - np.float32(self.floor)
        if self.scale == "seen":
            x, y = (first + centre)[:, :2].T / np.hypot(*(first + centre)[:, :2].T).clip(1e-6)
            points[..., :2] @= np.stack([y, x, -x, y], axis=1).reshape(-1, 2, 2)
        return torch.from_numpy(np.asarray(points))

    @property
    def points(self) -> Float[Tensor, "n m 3"]:
        """All clouds in memory, each in its sample number 0, as evaluation sees them; a copy."""
        return self.take(torch.arange(len(self)))


@dataclass(frozen=True, eq=False)
class Labelled:
    """Clouds with labels that may be trained on.

    Attributes:
        clouds: n clouds.
        labels: [n] int64, or [n, C] probabilities.
        owner: their key in a batch: "y_source", "y_pseudo", "y_target_train"; "labels" for a
            module of somebody else.
        balanced: whether all classes are drawn equally often.
    """

    clouds: Clouds
    labels: Tensor
    owner: str = "labels"
    balanced: bool = False

    def __len__(self) -> int:
        return len(self.clouds)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the clouds."""
        return self.clouds.ids

    def at(self, index: Int[np.ndarray, " k"]) -> Labelled:
        """A part, by positions."""
        part, labels = self.clouds.at(index), self.labels[torch.from_numpy(index)]
        return dataclasses.replace(self, clouds=part, labels=labels)


def load_clouds(
    dataset: PointSet,
    split: str,
    points: int,
    starts: int = 1,
    cache_dir: Path | None = None,
    *,
    scale: str,
) -> Clouds:
    """A split's clouds about their centroids, each in `starts` samples of `points` farthest points.

    They come without their labels, and are not normalised again after sampling. Which points are
    farthest does not depend on a cloud's size: all scales share the indices in `cache_dir`.
    `scale` has no default: without it a net would silently see clouds of another size.
    """
    part = dataset.split(split)
    assert scale not in HEIGHTS or dataset.floor_m is not None
    key = f"{dataset.name}-{dataset.sha256[:16]}-{split}"
    order = farthest_points(part.points, points, starts, cache_dir, key)
    return Clouds.of(part.points, order, scale, dataset.floor_m or 0.0, part.ids)


def labels_of(dataset: PointSet, split: str) -> Int[Tensor, " n"] | None:
    """A split's labels, for those who may have them; None if the dataset has none."""
    if not dataset.labelled:
        return None
    return torch.from_numpy(np.array(dataset.labels[dataset.indices(split)]))
