"""How often intervals of a difference in balanced accuracy hold the truth, in made-up rooms.

    python -m tests.report.balanced_coverage

`qs3 report compare` takes errors about the mean of all objects, `qs3 report judge` about the recall
of each class, as the linearised mean of ratios has them. A third way is shown beside them: the
latter, with the factor m / (m - 1) of each class's own m rooms.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from qs3.report.clustered import t2, variances, weights
from qs3.report.judge.intervals import difference
from qs3.report.tables.paired import interval

WAYS = ("compare", "judge", "judge with a factor a class")


@dataclass(frozen=True)
class Rooms:
    """Objects of ten classes in rooms that have their own furniture.

    Attributes:
        title: of them.
        count: rooms.
        objects: in each of them, about.
        spread: of the classes' true differences, in [-spread, spread].
        mixed: a room has several classes; else a cluster is one object's scans, as test meshes are.
    """

    title: str
    count: int
    objects: int
    spread: float = 0.35
    mixed: bool = True

    def labels(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Class and room of each object; every class is there, in two rooms at least."""
        often = np.array([1, 3, 1.5, 17, 36, 11, 6.5, 3.6, 3.8, 17])
        if not self.mixed:
            kinds = np.repeat(np.arange(10), np.ceil(often / 4).astype(int) + 1)
            of = rng.permutation(np.resize(kinds, self.count))
            return np.repeat(of, self.objects), np.repeat(np.arange(self.count), self.objects)
        while True:
            shares = [rng.dirichlet(often / often.sum() * 4) for _ in range(self.count)]
            label = np.concatenate([rng.choice(10, self.objects, p=p) for p in shares])
            room = np.repeat(np.arange(self.count), self.objects)
            if min(len(set(room[label == k])) for k in range(10)) > 1:
                return label, room


DESIGNS = (
    Rooms("41 rooms of 26", 41, 26),
    Rooms("13 rooms of 26", 13, 26),
    Rooms("100 meshes of 2 scans", 100, 2, mixed=False),
    Rooms("100 meshes of 2 scans, classes alike", 100, 2, 0.0, mixed=False),
)


def rows(
    rng: np.random.Generator, design: Rooms, seeds: int, label: np.ndarray, room: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[s, n] whether A and B are right: effects of class, room, seed and object."""
    more = np.linspace(-design.spread, design.spread, 10)[[3, 8, 1, 6, 0, 9, 4, 2, 7, 5]][label]
    more = more + 0.15 * rng.normal(size=design.count)[room] + 0.05 * rng.normal(size=(seeds, 1))
    luck = rng.random((seeds, len(label)))
    luck = np.where(rng.random(len(label)) < 0.5, luck[0], luck)  # half of the objects: all seeds
    up = np.clip(0.2 + np.maximum(more, 0), 0, 1)
    down = np.clip(0.2 + np.maximum(-more, 0), 0, 1 - up)
    both = rng.random(len(label)) < 0.5
    a, b = luck < up, (luck >= up) & (luck < up + down)
    return a | (both & ~b), b | (both & ~a)


def ends(
    a: np.ndarray, b: np.ndarray, label: np.ndarray, room: np.ndarray
) -> list[tuple[float, float]]:
    """The intervals of the three `WAYS`."""
    d, weight = a.astype(float) - b, weights(label, True)
    first = interval(d, weight, room)
    second = difference(a, b, label, room, balanced=True)
    assert second.low is not None
    assert second.high is not None
    rooms = np.array([len(set(room[label == k])) for k in range(10)])
    recall = np.bincount(label, d.mean(axis=0)) / np.bincount(label)
    factor = np.sqrt(rooms / np.maximum(rooms - 1, 1))[label]
    of_seeds, of_rooms = variances((d - recall[label]) * weight * factor, room)
    half = math.sqrt(t2(int(room.max()) + 1) * of_rooms + t2(len(d)) * of_seeds)
    mean = float((d @ weight).mean())
    return [(first.low, first.high), (second.low, second.high), (mean - half, mean + half)]


def coverage(design: Rooms, seeds: int, draws: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Share of intervals that hold the truth, and their mean width, of each of the `WAYS`."""
    rng = np.random.default_rng(0)
    label, room = design.labels(rng)
    weight = weights(label, True)
    truth = np.mean(
        [((a * 1.0 - b) @ weight).mean() for a, b in
         (rows(rng, design, seeds, label, room) for _ in range(3 * draws))]
    )  # fmt: skip
    found = np.array([ends(*rows(rng, design, seeds, label, room), label, room)
                      for _ in range(draws)])  # fmt: skip
    inside = (found[..., 0] <= truth) & (truth <= found[..., 1])
    return inside.mean(axis=0), (found[..., 1] - found[..., 0]).mean(axis=0)


def main() -> None:
    """A line a design, number of seeds and way."""
    for design in DESIGNS:
        for seeds in (3, 5):
            for way, share, width in zip(WAYS, *coverage(design, seeds), strict=True):
                said = f"{way} {share:.1%} ({100 * width:.1f} points wide)"
                sys.stdout.write(f"{design.title}, {seeds} seeds: {said}\n")


if __name__ == "__main__":
    main()
