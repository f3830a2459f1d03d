"""A dataset in memory: its splits, classes and counts, as they were written."""

import dataclasses

import numpy as np
import pytest

from qs3.errors import DataError
from qs3.store import store
from qs3.store.meta import MadeOf, ManifestRow
from tests.store.test_store import make


def scattered(folder, labels="0120", splits="aaba"):
    """Clouds of three classes, of which each shows its number; split a is train, b is test."""
    names = ("bed", "chair", "table")
    part = {"a": "train", "b": "test"}
    rows = [
        ManifestRow(str(i), names[int(label)], part[split])
        for i, (label, split) in enumerate(zip(labels, splits, strict=True))
    ]
    points = np.arange(len(rows))[:, None, None] + np.zeros((len(rows), 2, 3))
    return make(folder, rows=rows, arrays={"points": points}, classes=names)


def numbers(data):
    return data.points[:, 0, 0].astype(int).tolist()


@pytest.mark.parametrize("splits", ["aabbaa", "bbaaab", "ababab", "aaabbb", "abbbba", "bababb"])
def test_any_split_holds_its_own_clouds_and_no_others(tmp_path, splits):
    data = scattered(tmp_path / "d", "012012", splits)
    for letter, split in (("a", "train"), ("b", "test")):
        expected = [i for i, one in enumerate(splits) if one == letter]
        part = data.split(split)
        assert numbers(part) == expected
        assert part.ids == tuple(map(str, expected))
        assert part.labels.tolist() == [i % 3 for i in expected]
        adjacent = expected == list(range(expected[0], expected[-1] + 1))
        assert np.shares_memory(part.points, data.points) == adjacent
        assert part.sha256 == data.sha256
    with pytest.raises(DataError):
        data.split("validation")


def test_members_and_counts_of_each_class(tmp_path):
    data = scattered(tmp_path / "d", "0120221", "aababaa")
    assert [data.members(name).tolist() for name in data.classes] == [[0, 3], [1, 6], [2, 4, 5]]
    assert data.members("cat").tolist() == []
    assert data.counts() == {
        "train": {"bed": 2, "chair": 2, "table": 1},
        "test": {"bed": 0, "chair": 0, "table": 2},
    }
    assert [*data.split("test").counts()] == ["test"]
    assert data.labelled is True


def test_fewer_clouds_of_each_split_at_even_steps(tmp_path):
    data = scattered(tmp_path / "d", "0120120", "abaabaa")
    assert numbers(data.fewer(2)) == [0, 1, 3, 4]  # of 0, 2, 3, 5, 6 and of 1, 4
    assert numbers(data.fewer(9)) == [*range(7)]


def test_clouds_without_classes_have_the_label_minus_1(tmp_path):
    without = [ManifestRow(str(i), "", "train") for i in range(4)]
    failed = [
        ManifestRow(name, "", "test", status="failed", reason="no points") for name in ("x", "y")
    ]
    points = {"points": np.zeros((4, 2, 3))}
    for rows in (without, [*without, *failed]):
        data = make(tmp_path / "d", rows=rows, arrays=points, classes=("bed", "chair", "table"))
        assert data.labels.tolist() == [-1] * 4
        assert data.labelled is False
        assert data.meta["labelled"] is False
        assert data.meta["failed"] == len(rows) - 4
        assert data.counts() == {"train": {"bed": 0, "chair": 0, "table": 0}}
    assert "labelled" not in scattered(tmp_path / "e").meta
    assert scattered(tmp_path / "g", "1111", "aaaa").labelled is True


def test_evenly_is_at_even_steps_from_the_first_on():
    positions = np.arange(10) * 3
    assert store.evenly(positions, 4) == [0, 6, 15, 21]
    assert store.evenly(positions, 10) == store.evenly(positions, 99) == positions.tolist()
    assert store.evenly(positions, 1) == [0]
    assert store.evenly(positions[:0], 4) == []
    assert all(type(each) is int for each in store.evenly(positions, 3))


def test_the_table_of_counts_line_by_line(tmp_path):
    data = scattered(tmp_path / "d", "0100" * 3, "aaba" * 3)
    lines = store.counts_text(data, "failed", {"chair": 20})
    assert [line.split() for line in lines] == [
        ["clouds", "train", "test", "failed"],
        ["bed", "6", "3", "0"],
        ["chair", "3", "0", "20"],
        ["all", "9", "3", "20"],  # no line for a class without anything
    ]
    assert len({len(line) for line in lines}) == 1  # numbers end below each other
    assert lines[1].endswith(" 0")


def test_clouds_of_a_dataset_cannot_be_put_in_place_of_others(tmp_path):
    data = make(tmp_path / "d")
    with pytest.raises(dataclasses.FrozenInstanceError):
        data.labels = data.labels[::-1]
    assert data != dataclasses.replace(data)  # arrays have no single truth to compare
    meta = {"made_of": {"objects": "arrays of x.npz"}}
    assert str(make(tmp_path / "e", meta=meta).made_of) == str(MadeOf.of(meta))


def test_what_a_dataset_is_made_of_in_words():
    full = MadeOf(objects="o", sensor="s", views=2, without="lamp", benchmark="b v2")
    assert str(full) == "o, s, 2 views, without lamp, b v2"
    assert str(dataclasses.replace(full, views=1)) == "o, s, 1 view, without lamp, b v2"
    assert str(MadeOf(objects="o")) == "o"
    assert MadeOf.of(full.meta) == full != MadeOf.of({})
    assert not MadeOf().published
    with pytest.raises(dataclasses.FrozenInstanceError):
        full.views = 3
