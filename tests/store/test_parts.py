"""Parts of unfinished datasets: one that is damaged is named, however it is."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from qs3.errors import ConfigError, DataError
from qs3.store.parts import PartFiles
from tests.fixtures.harm import Harm


@pytest.mark.parametrize("content", [b"", b"PK", b"PK\x05\x06" + bytes(18)])
def test_a_damaged_part_is_named_and_nothing_is_unpickled(content, tmp_path):
    parts = PartFiles(tmp_path)
    parts.begin({"a": 1})
    parts.write("x", {"n": 1}, {"points": np.zeros(3)})
    assert parts.read("x")[0] == {"n": 1}
    (path,) = tmp_path.rglob("x.npz")
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.npz"):
        parts.read("x")
    harmful = np.array(Harm(tmp_path / "harm"), dtype=object)
    np.savez(path, note=harmful, points=harmful)
    with pytest.raises(DataError, match=r"x\.npz"):
        parts.read("x")
    assert not (tmp_path / "harm").exists()


BEGUN = {
    "settings": {"sensor": {"baseline_m": 0.1, "name": "a"}, "views": 5},
    "objects": ["a", "b", "c"],
    "poses": [1, 2],
    "looks": [1, 2],
    "note": "x",
}


@pytest.mark.parametrize(
    ("change", "keys"),
    [
        (
            {"settings": {"sensor": {"baseline_m": 0.2, "name": "a"}, "views": 5}},
            ["sensor.baseline_m"],
        ),
        ({"settings": {"sensor": "none", "more": 1}}, ["sensor", "views", "more"]),
        ({"poses": [2], "objects": ["a"]}, ["objects", "poses"]),
        ({"note": "y" * 100}, ["note"]),
    ],
)
def test_what_differs_is_named_by_its_key(tmp_path, change, keys):
    PartFiles(tmp_path).begin(BEGUN)
    PartFiles(tmp_path).check({**BEGUN, "poses": (1, 2)})  # as JSON has it
    with pytest.raises(ConfigError) as refused:
        PartFiles(tmp_path).check({**BEGUN, **change})
    found = [line.split(":")[0].strip() for line in str(refused.value).split("\n")[1:-1]]
    assert [key.removeprefix("settings.") for key in found] == keys


@pytest.mark.parametrize("content", [b"{", b"\xff"])
def test_a_recipe_that_cannot_be_read_is_named(tmp_path, content):
    (tmp_path / "recipe.json").write_bytes(content)
    with pytest.raises(DataError):
        PartFiles(tmp_path).begin({})


def test_a_node_knows_whether_it_sees_the_same_dataset(tmp_path):
    parts = PartFiles(tmp_path)
    with pytest.raises(DataError):
        parts.check_there("")
    parts.begin(BEGUN)
    digest = hashlib.sha256((tmp_path / "recipe.json").read_bytes()).hexdigest()
    assert parts.recipe_sha256() == digest
    parts.check_there(digest)
    with pytest.raises(DataError):
        parts.check_there("0" * 64)


def test_arrays_are_read_when_they_are_asked_for(tmp_path):
    parts = PartFiles(tmp_path)
    parts.begin({})
    arrays = {"a": np.arange(3), "note_too": np.ones(2), "z": np.zeros(1)}
    parts.write("one", {"x": 1}, arrays)
    note, found = parts.read("one")
    assert (note, list(found), len(found)) == ({"x": 1}, ["a", "note_too", "z"], 3)
    np.testing.assert_array_equal(found["a"], [0, 1, 2])
    for key in ("note", "b"):
        with pytest.raises(KeyError):
            found[key]
    data = bytearray((tmp_path / "parts" / "one.npz").read_bytes())
    data[data.index(b"\x93NUMPY") + 130] ^= 1
    (tmp_path / "parts" / "one.npz").write_bytes(data)
    with pytest.raises(DataError):
        dict(parts.read("one")[1])
