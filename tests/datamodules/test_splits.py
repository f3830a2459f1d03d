"""Which labelled clouds validate."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.datamodules.splits import lineage, stratified
from qs3.errors import DataError


def parts(rule, ids: list[str], labels=None) -> tuple[list[str], list[str]]:
    labels = np.zeros(len(ids), dtype=np.int64) if labels is None else np.asarray(labels)
    train, validation = rule(ids, labels)
    assert sorted([*train, *validation]) == list(range(len(ids)))
    return [ids[i] for i in train], [ids[i] for i in validation]


def test_ninth_and_tenth_of_the_sorted_ids_validate():
    ids = [f"chair/train/{i:03d}" for i in range(25)]
    train, validation = parts(lineage, ids[::-1])
    assert validation == [ids[i] for i in (8, 9, 18, 19)]
    assert train == [i for i in ids if i not in validation]


def scans_of(objects: list[str]) -> list[str]:
    return [f"{name}{more}" for name in objects for more in ("", "~1", "~2", "~10")]


def test_all_scans_of_a_mesh_stay_on_one_side():
    meshes = [f"chair/train/chair_{i:04d}" for i in range(1, 31)]
    sides = [{name.partition("~")[0] for name in part} for part in parts(lineage, scans_of(meshes))]
    assert not sides[0] & sides[1]
    assert sides[1] == {meshes[i] for i in (8, 9, 18, 19, 28, 29)}
    once, _ = parts(lineage, meshes)
    assert set(once) == sides[0]  # as with one scan of each


def test_scans_do_not_replace_objects():
    with pytest.raises(DataError):
        parts(lineage, [f"{i}{more}" for i in range(8) for more in ("", "~1")])


# --- stratified -------------------------------------------------------------------------------


def classes_of(sizes: list[int]) -> tuple[list[str], np.ndarray]:
    ids = [f"c{k}/train/{i:03d}" for k, size in enumerate(sizes) for i in range(size)]
    return ids, np.repeat(np.arange(len(sizes)), sizes)


def test_a_fifth_of_each_class_and_at_least_one():
    ids, labels = classes_of([100, 13, 2, 1, 0, 7])
    _, validation = parts(stratified, ids, labels)
    counts = Counter(name[:2] for name in validation)
    assert counts == {"c0": 20, "c1": 3, "c2": 1, "c5": 1}  # the only object of c3 trains


@given(st.permutations(range(60)))
def test_the_order_of_the_clouds_changes_nothing(order):
    ids, labels = classes_of([30, 20, 10])
    expected = parts(stratified, ids, labels)
    assert parts(stratified, [ids[i] for i in order], labels[list(order)]) == expected


def test_stratified_takes_these_everywhere():
    ids = [f"a/{i}" for i in range(40)]
    _, validation = stratified(ids, np.zeros(40, int))
    assert validation.tolist() == [16, 27, 31, 32, 35, 36, 38, 6]


def test_nothing_to_validate_on():
    with pytest.raises(DataError):
        parts(stratified, ["a/1", "b/1", "c/1", "c/1~1"], [0, 1, 2, 2])
    with pytest.raises(AssertionError):
        parts(stratified, ["c/1", "c/1~1"], [0, 1])
