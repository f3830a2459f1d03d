"""Which training clouds a run has, and which validate: by their ids, not by chance.

Further scans of an object (`generate.py scans=N` calls them id~1, id~2, ...) go where it goes:
else training would see the validation shapes.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from qs3.errors import DataError
from qs3.store.meta import FURTHER_SCAN


def lineage(ids: Sequence[str]) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """(train, validation): of the objects sorted by id, positions with i % 10 >= 8 validate.

    The rule of DefRec, GAST and QS3. Ids begin with the class, so each class is split about 4 : 1.

    Raises:
        DataError: fewer than nine objects, so that there is nothing to validate on.
    """
    objects, place = np.unique([FURTHER_SCAN.sub("", name) for name in ids], return_inverse=True)
    order = np.argsort(np.array(ids), kind="stable")
    validates = place[order] % 10 >= 8
    if not validates.any():
        raise DataError(f"{len(objects)} labelled training objects: validation needs 9")
    return order[~validates], order[validates]


def first_of_class(
    index: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"], count: int
) -> Int[np.ndarray, " k"]:
    """The first `count` of each class among some positions in `labels`."""
    left = [np.flatnonzero(labels[index] == k)[:count] for k in np.unique(labels[index])]
    return index[np.sort(np.concatenate(left))]
