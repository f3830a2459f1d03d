"""Adam over the numbers of a sensor, by how far its clouds are from the target's."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import DataError
from qs3.tuning.features import Distance
from qs3.tuning.parameters import as_floats, bounded
from qs3.tuning.state import State

_FIRST, _SECOND = 0.9, 0.99
LAST = 0.25
"""Share of the steps, at the end, whose numbers are averaged: single steps still shake."""

STEP = 0.6
"""Of differences, in logits, at first: over what single pixels do by chance. At last a quarter."""


class Seen(Protocol):
    """An object that gives clouds by any numbers of the sensor: `scenes.Still`."""

    def cloud(self, values: dict[str, Tensor], points: int, seed: int) -> Float[Tensor, "n 3"]:
        """By the twin, with gradients; see `Still.cloud`."""
        ...

    def measured(self, values: dict[str, float], points: int) -> Float[Tensor, "n 3"]:
        """By the ordinary sensor; see `Still.measured`."""
        ...


def by_differences(
    numbers: Sequence[float],
    keys: Sequence[str],
    objects: Sequence[Seen],
    distance: Distance,
    points: int,
    apart: float = STEP,
) -> tuple[float, np.ndarray]:
    """The distance of the objects' clouds, and its slope [K] by the free numbers.

    Central differences of the ordinary sensor, whose random numbers are the same on both sides:
    1 + 2 K clouds of each object. Objects that it does not see on one side are left out. Both sides
    are `apart` from the numbers, in logits.

    Raises:
        DataError: fewer than two objects give clouds.
    """
    at = np.array(numbers)
    steps = [
        np.zeros(len(at)),
        *(sign * apart * one for one in np.eye(len(at)) for sign in (1, -1)),
    ]
    rows = []
    for one in objects:
        with contextlib.suppress(DataError), torch.no_grad():
            clouds = [one.measured(_values(at + step, keys), points) for step in steps]
            rows.append(torch.cat([distance.describe(cloud[None]) for cloud in clouds]))
    _check_count(rows)
    with torch.no_grad():
        found = [float(distance.of(described)) for described in torch.stack(rows, dim=1)]
    return found[0], (np.array(found[1::2]) - np.array(found[2::2])) / (2 * apart)


def by_twin(
    numbers: Sequence[float],
    keys: Sequence[str],
    objects: Sequence[Seen],
    distance: Distance,
    points: int,
    seed: int,
) -> tuple[float, np.ndarray]:
    """As `by_differences`: the distance of the ordinary sensor, the slope of its twin.

    One cloud of each and one backward pass, however many numbers there are. What the twin lacks
    (holes, filters, the matcher's own noise) moves slopes, and no minimum; where the sensor's
    errors are not the twin's, they can point the wrong way.
    """
    at = torch.tensor(list(numbers), dtype=torch.float64)
    described, there = [], []
    for one in objects:
        with contextlib.suppress(DataError), torch.no_grad():
            cloud = one.measured(_values(np.array(numbers), keys), points)
            described.append(distance.describe(cloud[None]))
            there.append(one)
    _check_count(there)
    leaf = torch.cat(described).requires_grad_()
    found = distance.of(leaf)
    (pulls,) = torch.autograd.grad(found, leaf)
    at.requires_grad_()
    for one, pull in zip(there, pulls, strict=True):
        with contextlib.suppress(DataError):
            ours = distance.describe(one.cloud(bounded(at, keys), points, seed)[None])[0]
            (ours * pull).sum().backward()
    slope = np.zeros(len(keys)) if at.grad is None else torch.nan_to_num(at.grad).numpy()
    return float(found.detach()), slope


def _values(numbers: np.ndarray, keys: Sequence[str]) -> dict[str, float]:
    return as_floats(bounded(torch.from_numpy(numbers), keys))


def _check_count(there: Sequence[object]) -> None:
    if len(there) < 2:
        raise DataError(
            "the sensor sees next to nothing of these objects: begin with another preset"
        )


def search(
    state: State,
    keys: Sequence[str],
    objects: Sequence[Seen],
    distance: Distance,
    *,
    steps: int,
    batch: int,
    points: int,
    rate: float,
    seed: int,
    slopes: str = "differences",
    after: Callable[[State], None] = lambda state: None,
) -> State:
    """Go on from `state` until there are `steps`; the same steps however often it is interrupted.

    Args:
        state: changed in place.
        keys: of its numbers.
        objects: to train on; each step draws `batch` of them.
        distance: to the target.
        points: of a cloud.
        rate: of Adam, in logits of a number's range.
        seed: of the draws, and of the twin's noise.
        slopes: "differences" or "twin", see `by_differences` and `by_twin`.
        after: called with the state after each step, e.g. to write it.
    """
    while state.steps < steps:
        k = state.steps
        rng = np.random.default_rng([seed, k])
        drawn = rng.permutation(len(objects))[:batch]
        some = [objects[i] for i in drawn]
        left = 0.5 * (1 + np.cos(np.pi * k / steps))  # 1 at first, 0 at last
        if slopes == "twin":
            found, slope = by_twin(state.numbers, keys, some, distance, points, seed)
        else:
            apart = STEP * (0.25 + 0.75 * left)
            found, slope = by_differences(state.numbers, keys, some, distance, points, apart)
        mean = _FIRST * np.array(state.mean) + (1 - _FIRST) * slope
        square = _SECOND * np.array(state.square) + (1 - _SECOND) * slope**2
        straight = mean / (1 - _FIRST ** (k + 1))
        wide = np.sqrt(square / (1 - _SECOND ** (k + 1)))
        step = rate * (0.1 + 0.9 * left) * straight / (wide + 1e-12)
        state.path.append(list(state.numbers))
        state.numbers = [float(a - b) for a, b in zip(state.numbers, step, strict=True)]
        state.mean, state.square = [float(m) for m in mean], [float(s) for s in square]
        state.distances.append(found)
        after(state)
    return state


def settled(state: State) -> list[float]:
    """The mean of the last numbers."""
    last = max(1, round(LAST * len(state.path)))
    every = np.array([*state.path, state.numbers])
    return [float(value) for value in every[-last:].mean(axis=0)]
