"""How often intervals of balanced accuracy and of its differences hold the truth, in made-up rooms.

    python -m tests.report.balanced_coverage

What an object adds to the variance is its error about the mean of all objects, about the recall of
its class, or that over √(1 - h), see `qs3.report.judge.intervals`. `qs3 report compare` takes
the first for its differences, `qs3 report judge` the first for them and the last for shares.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from qs3.report.clustered import t2, variances, weights

WAYS = ("about the mean", "about the recalls", "about the recalls, corrected")
OF = ("difference", "share")


@dataclass(frozen=True)
class Rooms:
    """Objects of ten classes in rooms that have their own furniture.

    Attributes:
        title: of them.
        count: rooms.
        objects: in each of them, about.
        spread: of the classes' true differences, in [-spread, spread].
        mixed: a room has several classes; else a cluster is one object's scans, as test meshes are.
        hard: how much easier and harder than the middle one classes are, for both rows.
    """

    title: str
    count: int
    objects: int
    spread: float = 0.35
    mixed: bool = True
    hard: float = 0.0

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
    Rooms("41 rooms of 26, easy and hard classes", 41, 26, 0.1, hard=0.4),
    Rooms("13 rooms of 26, easy and hard classes", 13, 26, 0.1, hard=0.4),
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
    easy = design.hard * np.linspace(-1, 1, 10)[[0, 9, 2, 7, 5, 1, 8, 4, 3, 6]][label]
    both = rng.random(len(label)) < 0.5 + easy
    a, b = luck < up, (luck >= up) & (luck < up + down)
    return a | (both & ~b), b | (both & ~a)


def ends(values: np.ndarray, label: np.ndarray, room: np.ndarray) -> list[tuple[float, float]]:
    """The intervals of the three `WAYS`; values: [s, n] of each seed and object."""
    weight = weights(label, True)
    mean = float((values @ weight).mean())
    recall = np.bincount(label, values.mean(axis=0)) / np.bincount(label)
    of = np.zeros((10, int(room.max()) + 1))
    np.add.at(of, (label, room), 1)
    left = 1 - (of / of.sum(axis=1, keepdims=True))[label, room]
    about = values - recall[label]
    found = []
    for errors in (values - mean, about, about / np.sqrt(left)):
        of_seeds, of_rooms = variances(errors, weight, room)
        half = math.sqrt(t2(int(room.max()) + 1) * of_rooms + t2(len(values)) * of_seeds)
        found.append((mean - half, mean + half))
    return found


def coverage(design: Rooms, seeds: int, draws: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """[2, 3]: of both `OF` the share of intervals that hold the truth, and their mean width.

    A column for each of the `WAYS`.
    """
    rng = np.random.default_rng(0)
    label, room = design.labels(rng)

    def drawn() -> np.ndarray:
        a, b = rows(rng, design, seeds, label, room)
        return np.stack([a.astype(float) - b, a.astype(float)])  # [2, s, n]

    truth = np.mean([(drawn() @ weights(label, True)).mean(axis=1) for _ in range(3 * draws)], 0)
    found = np.array([[ends(one, label, room) for one in drawn()] for _ in range(draws)])
    low, high = found[..., 0], found[..., 1]  # [draws, 2, 3]
    inside = (low <= truth[:, None]) & (truth[:, None] <= high)
    return inside.mean(axis=0), (high - low).mean(axis=0)


def main() -> None:
    """A line a design, number of seeds and way."""
    for design in DESIGNS:
        for seeds in (3, 5):
            for of, *both in zip(OF, *coverage(design, seeds), strict=True):
                for way, share, width in zip(WAYS, *both, strict=True):
                    said = f"{of} {way} {share:.1%} ({100 * width:.1f} points wide)"
                    sys.stdout.write(f"{design.title}, {seeds} seeds: {said}\n")


if __name__ == "__main__":
    main()
