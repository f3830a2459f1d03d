"""manifest.csv of a store: any comes back, and a wrong line is named."""

import csv
import dataclasses
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.data.test_store import CLASSES, make

from qs3.errors import DataError
from qs3.store import store
from qs3.store.store import ManifestRow, open_pointset, write_pointset

text = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=9)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), n=st.integers(1, 6), p=st.integers(1, 4))
def test_any_manifest_round_trips(tmp_path_factory, data, n, p):
    ids = data.draw(st.lists(text, min_size=n, max_size=n, unique=True))
    rows = [
        ManifestRow(
            id=name,
            cls=data.draw(st.sampled_from(CLASSES)),
            split=data.draw(st.sampled_from(store.SPLITS)),
            seed=data.draw(st.none() | st.integers(0, 2**64)),
            origin=data.draw(text | st.sampled_from(["", 'a "b", c', "x;y"])),
            views=data.draw(st.none() | st.integers(1, 9)),
        )
        for name in ids
    ]
    folder = tmp_path_factory.mktemp("round")
    values = data.draw(
        st.lists(st.floats(-(2.0**99), 2.0**99, width=32), min_size=n * p * 3, max_size=n * p * 3)
    )
    points = np.array(values, dtype="f4").reshape(n, p, 3)
    made = write_pointset(
        folder, name="any", classes=CLASSES, arrays={"points": points}, rows=rows, meta={}
    )
    found = store.read_manifest(folder, CLASSES)
    assert [dataclasses.replace(row, index=None) for row in found] == rows
    np.testing.assert_array_equal(made.points, points)
    shutil.rmtree(folder)


def test_manifest_errors_name_the_line(tmp_path):
    make(tmp_path / "d")
    path = tmp_path / "d" / "manifest.csv"
    good = list(csv.reader(path.read_text().splitlines()))

    def error(line, column, value):
        rows = [list(row) for row in good]
        rows[line - 1][good[0].index(column)] = value
        with path.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
        with pytest.raises(DataError) as caught:
            open_pointset(tmp_path / "d")
        return str(caught.value)

    assert "line 4 (id 'chair/1'): index is 7, expected 1" in error(4, "index", "7")
    assert "line 4: index is 'x', not a number" in error(4, "index", "x")
    assert "line 5 (id 'bed/2'): unknown class 'cat'" in error(5, "class", "cat")
    assert "line 5 (id 'bed/0'): the same id is already in line 2" in error(5, "id", "bed/0")
    assert "line 4 (id 'chair/1'): index is 0, expected 1" in error(4, "index", "0")
    assert "line 4 (id 'chair/1'): unknown class ''" in error(4, "class", "")
    assert "line 3 (id 'bed/bad'): unknown class 'cat'" in error(3, "class", "cat")
    assert "line 6 (id 'bed/out'): unknown class 'cat'" in error(6, "class", "cat")
    assert "an object that is not ok has no index" in error(6, "index", "3")
    assert "an object that is not ok has no index" in error(3, "reason", "")
    assert "line 2 (id 'bed/0'): unknown split ''" in error(2, "split", "")
    assert "line 1: the columns are not" in error(1, "split", "part")
    assert "line 1: the columns are not" in error(1, "split", "zone")
    path.write_text(path.read_text().replace("bed/bad", '"bed/bad'))
    with pytest.raises(DataError, match=r"manifest\.csv is empty or damaged \("):
        store.read_manifest(tmp_path / "d", CLASSES)
    path.write_text("")
    with pytest.raises(DataError, match=r"manifest\.csv is empty or damaged \("):
        store.read_manifest(tmp_path / "d", CLASSES)
