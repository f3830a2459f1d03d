"""manifest.csv of a store: any comes back, and a changed one is refused."""

import dataclasses
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import DataError
from qs3.store.meta import SPLITS, ManifestRow, from_csv, number, read_manifest, to_csv
from qs3.store.store import write_pointset
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
    found = read_manifest(folder)
    assert [dataclasses.replace(row, index=None) for row in found] == rows
    np.testing.assert_array_equal(made.points, points)
    shutil.rmtree(folder)


@pytest.mark.parametrize("text", ["", "index,id\n"])
def test_what_is_not_a_manifest(tmp_path, text):
    make(tmp_path / "d")
    (tmp_path / "d" / "manifest.csv").write_text(text)
    with pytest.raises(DataError, match=r"manifest\.csv"):
        read_manifest(tmp_path / "d")


def rows(*more):
    return number(
        [ManifestRow(f"chair/test/{i}", "chair", "test", more=of) for i, of in enumerate(more)]
    )


def test_as_written():
    made = rows({"tier": "clean"}, {}, {"sensor": "kv1", "tier": 'a "quoted", one'})
    assert from_csv(to_csv(made)) == made
    assert hash(made[0]) == hash(rows({})[0])


def test_without_them_nothing_is_added():
    assert to_csv(rows({}, {})).splitlines()[0].endswith("status,reason")
