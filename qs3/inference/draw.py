"""`sample=` of `qs3 predict`: so many of all objects, drawn at random, always the same ones.

What is read at a time, a file or a depth image, may hold several objects. They are counted first,
by what is cheap to read: masks, headers of arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from qs3.datasets.clouds import npy_clouds, parse_clouds
from qs3.datasets.depth_images import read_mask
from qs3.errors import Qs3Error
from qs3.inference.depth_list import Shown
from qs3.inference.inputs import Sample, Unit
from qs3.inference.settings import Inputs
from qs3.inference.table import Row

_SEVERAL = (".npz", ".h5", ".hdf5")
"""Files that may hold several clouds and are read to count them; of an .npy the header tells."""


def draw(inputs: Inputs, count: int | None) -> Inputs:
    """The same with `count` of its objects; all of them if it has not more, or for None."""
    if count is None:
        return inputs
    sizes = [1] * len(inputs.units) if inputs.sizes is None else inputs.sizes()
    if count >= sum(sizes):
        return inputs
    chosen = np.sort(np.random.default_rng(0).choice(sum(sizes), count, replace=False))
    units, drawn, first = [], [], 0
    for unit, size in zip(inputs.units, sizes, strict=True):
        wanted = (chosen[(chosen >= first) & (chosen < first + size)] - first).tolist()
        first += size
        if len(wanted) == size:
            units.append(unit)
        elif wanted:
            units.append(functools.partial(_some, unit, wanted, size))
        drawn += [len(wanted)] if wanted else []
    return inputs._replace(units=units, sizes=lambda: drawn)


def clouds_in(files: Sequence[Path]) -> list[int]:
    """How many clouds each file holds; 1 if it cannot be read, which is told in a row."""
    return [_clouds_in(path) for path in files]


def objects_in(shown: Sequence[Shown]) -> list[int]:
    """How many objects are meant of each depth image; likewise."""
    return [_objects_in(one) for one in shown]


def _some(unit: Unit, wanted: Sequence[int], size: int) -> Iterator[Sample | Row]:
    found = list(unit())
    if len(found) != size:  # damaged: it says so
        yield from found
        return
    yield from (found[i] for i in wanted)


def _clouds_in(path: Path) -> int:
    try:
        if path.suffix.lower() == ".npy":
            return npy_clouds(path) or 1
        return len(parse_clouds(path).clouds) if path.suffix.lower() in _SEVERAL else 1
    except Qs3Error:
        return 1


def _objects_in(shown: Shown) -> int:
    if shown.mask is None or shown.only is not None or shown.wrong:
        return 1
    try:
        return int((np.unique(read_mask(shown.mask)) != 0).sum())
    except Qs3Error:
        return 1
