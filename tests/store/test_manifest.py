"""manifest.csv of a store: any comes back, and a wrong line is named."""

import csv
import dataclasses
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import DataError
from qs3.store.meta import SPLITS, ManifestRow, number, read_manifest, to_csv
from qs3.store.store import open_pointset, write_pointset
from tests.store.test_store import CLASSES, make

text = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=9)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), n=st.integers(1, 6), p=st.integers(1, 4))
def test_any_manifest_round_trips(tmp_path_factory, data, n, p):
    ids = data.draw(st.lists(text, min_size=n, max_size=n, unique=True))
    rows = [
        ManifestRow(
            id=name,
            cls=data.draw(st.sampled_from(CLASSES)),
            split=data.draw(st.sampled_from(SPLITS)),
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
    found = read_manifest(folder, CLASSES)
    assert [dataclasses.replace(row, index=None) for row in found] == rows
    np.testing.assert_array_equal(made.points, points)
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("line", "column", "value"),
    [
        *((4, "index", index) for index in ("7", "0", "x")),
        *((line, "class", "cat") for line in (3, 5, 6)),
        (4, "class", ""),
        (5, "id", "bed/0"),
        (6, "index", "3"),
        (3, "reason", ""),
        (2, "split", ""),
        (1, "split", "part"),
    ],
)
def test_a_wrong_value_names_the_line(tmp_path, line, column, value):
    make(tmp_path / "d")
    path = tmp_path / "d" / "manifest.csv"
    rows = list(csv.reader(path.read_text().splitlines()))
    rows[line - 1][rows[0].index(column)] = value
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
    with pytest.raises(DataError, match=rf"manifest\.csv.*line {line}\b"):
        open_pointset(tmp_path / "d")


@pytest.mark.parametrize("text", ["", 'index,"id', "index,id\n", "z\n"])
def test_what_is_not_a_manifest(tmp_path, text):
    make(tmp_path / "d")
    (tmp_path / "d" / "manifest.csv").write_text(text)
    with pytest.raises(DataError, match=r"manifest\.csv"):
        read_manifest(tmp_path / "d", CLASSES)


def rows(*more):
    return number(
        [ManifestRow(f"chair/test/{i}", "chair", "test", more=of) for i, of in enumerate(more)]
    )


def test_as_written(tmp_path):
    made = rows({"tier": "clean"}, {}, {"sensor": "kv1", "tier": 'a "quoted", one'})
    (tmp_path / "manifest.csv").write_text(to_csv(made))
    assert read_manifest(tmp_path, ["chair"]) == made
    assert hash(made[0]) == hash(rows({})[0])


def test_without_them_nothing_is_added(tmp_path):
    text = to_csv(rows({}, {}))
    assert text.splitlines()[0].endswith("status,reason")
    twice = "\n".join(line + ",id" for line in text.splitlines())
    (tmp_path / "manifest.csv").write_text(twice)
    with pytest.raises(DataError):
        read_manifest(tmp_path, ["chair"])
    (tmp_path / "manifest.csv").write_text(text.replace("status,reason", "status,reason,tier"))
    with pytest.raises(DataError):
        read_manifest(tmp_path, ["chair"])
