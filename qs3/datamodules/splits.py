"""Which training clouds a run has, and which validate: functions of ids and labels, not of chance.

Further scans of an object (`generate.py scans=N` calls them id~1, id~2, ...) go where it goes:
else training would see the validation shapes.
"""

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Int

from qs3.errors import DataError
from qs3.store.meta import FURTHER_SCAN
from qs3.utils.seeding import derive

STRATIFIED_SEED = 0
STRATIFIED_SHARE = 0.2  # of each class's objects, as large as the lineage's part


def lineage(
    ids: Sequence[str], labels: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """(train, validation): of the objects sorted by id, positions with i % 10 >= 8 validate.

    The rule of DefRec, GAST and QS3. Ids begin with the class, so each class is split about 4 : 1.

    Raises:
        DataError: fewer than nine objects, so that there is nothing to validate on.
    """
    objects, place = _objects(ids)
    order = np.argsort(np.array(ids), kind="stable")
    validates = place[order] % 10 >= 8
    if not validates.any():
        raise DataError(f"{len(objects)} labelled training objects: data.val=lineage needs 9")
    return order[~validates], order[validates]


def stratified(
    ids: Sequence[str], labels: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " v"]]:
    """(train, validation): of each class a fifth of its objects validates, rounded, at least one.

    They are the first by a hash of (`STRATIFIED_SEED`, id), so the split is the same for every run
    and order of clouds. The only object of a class trains. Both parts are sorted by id.

    Raises:
        DataError: no class has two objects.
    """
    objects, place = _objects(ids)
    cls = np.full(len(objects), -1)
    cls[place] = labels
    assert (cls[place] == labels).all(), "scans of an object with labels of two classes"
    rank = np.array([derive(STRATIFIED_SEED, "validation", str(name)) for name in objects])
    validates = np.zeros(len(objects), dtype=bool)
    for label in np.unique(cls):
        members = np.flatnonzero(cls == label)
        if len(members) > 1:
            count = max(1, round(STRATIFIED_SHARE * len(members)))
            validates[members[np.argsort(rank[members])][:count]] = True
    if not validates.any():
        raise DataError("data.val=stratified needs a class with two labelled training objects")
    order = np.argsort(np.array(ids), kind="stable")
    chosen = validates[place[order]]
    return order[~chosen], order[chosen]


def _objects(ids: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The objects' names, sorted, and of each cloud which object it shows."""
    return np.unique([FURTHER_SCAN.sub("", name) for name in ids], return_inverse=True)


RULES = MappingProxyType({"lineage": lineage, "stratified": stratified})


def first_of_class(
    index: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"], count: int
) -> Int[np.ndarray, " k"]:
    """Of some positions in `labels` the first `count` of each class; for `debug=overfit`."""
    left = [np.flatnonzero(labels[index] == k)[:count] for k in np.unique(labels[index])]
    return index[np.sort(np.concatenate(left))]
