"""A simulated sensor drawn anew for each cloud and epoch, from views that a store keeps.

Domain randomisation (Tobin et al., "Domain Randomization for Transferring Deep Neural Networks from
Simulation to the Real World", IROS 2017) without a render: of the kept views of an object some are
fused, and its points lie anywhere between where they were measured and where they are. Cuts by
planes, which hide parts, are drawn after that, by `protocol.augment.crop`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from qs3.geometry.sampling import farthest_point_sampling_np

POOL = 2
"""So many points of the fused views are there for each one of which farthest points are taken."""

Stored = Float[np.ndarray, "N P 3"]


@dataclass(frozen=True, eq=False)
class RandomViews:
    """n objects of V views each, of which a batch has clouds of m points.

    Attributes:
        measured: V arrays [N, P, 3], each cloud in the order of farthest point sampling.
        exact: where these points would be without error, [N, P, 3] each; empty if nobody knows.
        points: m.
        rows: [n] which of the N objects these are.
        scale, floor: as of `qs3.datamodules.clouds.Clouds`. A cloud is normalised by what was drawn
            for it, as a scan of those views alone would be.
    """

    measured: Sequence[Stored]
    exact: Sequence[Stored]
    points: int
    rows: Int[np.ndarray, " n"]
    scale: str
    floor: float

    def __len__(self) -> int:
        """How many there are."""
        return len(self.rows)

    def at(self, index: Shaped[np.ndarray, " k"]) -> RandomViews:
        """A part, by positions or by a mask; nothing is copied."""
        return dataclasses.replace(self, rows=self.rows[index])

    def draw(self, n: int, generator: torch.Generator) -> Float[Tensor, "n draws"]:
        """What decides the sensors of n clouds: numbers in [0, 1), V + 2 of each."""
        return torch.rand(n, len(self.measured) + 2, generator=generator)

    def take(
        self, index: Int[Tensor, " b"], draw: Float[Tensor, "b draws"]
    ) -> Float[Tensor, "b m 3"]:
        """A batch: of each object at `index` a cloud as its row of `draw` says (see `drawn`)."""
        rows = self.rows[index.numpy()]
        return torch.from_numpy(
            np.stack([self._cloud(*one) for one in zip(rows, draw.numpy(), strict=True)])
        )

    def _cloud(self, row: int, draw: Float[np.ndarray, " draws"]) -> Float[np.ndarray, "m 3"]:
        views, noise = drawn(draw)
        each = -(-POOL * self.points // len(views))
        parts = []
        for v in views:
            part = np.asarray(self.measured[v][row][:each])
            if self.exact:
                exact = self.exact[v][row][:each]
                part = exact + np.float32(noise) * (part - exact)
            parts.append(part)
        pool = np.concatenate(parts)
        first = pool[:1]
        moved = pool - first
        centre = moved.mean(axis=0)
        moved -= centre
        cloud = moved[farthest_point_sampling_np(moved, self.points)]
        if self.scale == "unit_ball":
            cloud /= np.linalg.norm(moved, axis=1).max() or 1.0
        elif self.scale == "above_floor":
            cloud[:, 2] += first[0, 2] + centre[2] - np.float32(self.floor)
        return cloud


def drawn(draw: Float[np.ndarray, " draws"]) -> tuple[Int[np.ndarray, " k"], float]:
    """Which views are fused, any one to all of them, and the share of their error, U(0, 1).

    Of the V + 2 numbers the first V order the views, the next says how many of them, 1 to V, each
    equally likely, the last is the share.
    """
    views = len(draw) - 2
    count = 1 + min(int(draw[views] * views), views - 1)
    return np.argsort(draw[:views], kind="stable")[:count], float(draw[-1])
