"""Parts of unfinished datasets: one that is damaged is named, however it is."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import ConfigError, DataError
from qs3.store.meta import ManifestRow
from qs3.store.parts import (
    CLOUDS,
    CONFIG,
    RECIPE,
    VIEWS,
    PartFiles,
    check_ours,
    delete_dataset,
)
from qs3.store.store import write_pointset
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


def _dataset(folder):
    """A finished dataset that was generated, with everything that may lie there."""
    write_pointset(
        folder,
        name="d",
        classes=("a",),
        arrays={"points": np.zeros((1, 4, 3), np.float32)},
        rows=[ManifestRow("a/train/0", "a", "train")],
        meta={},
    )
    PartFiles(folder).begin({"seed": 0})
    PartFiles(folder).write("a", {}, {"points": np.zeros((4, 3), np.float32)})
    (folder / VIEWS).mkdir()
    for name in (CLOUDS, CONFIG, f"{VIEWS}/v.png", "notes.txt"):
        (folder / name).write_text("x")


def test_only_a_dataset_that_was_made_here_is_replaced(tmp_path):
    check_ours(tmp_path, "generate.py")  # nothing is there
    _dataset(tmp_path)
    check_ours(tmp_path, "generate.py")
    (tmp_path / RECIPE).unlink()
    with pytest.raises(DataError):
        check_ours(tmp_path, "generate.py")


def test_a_dataset_is_deleted_and_other_files_are_not(tmp_path):
    _dataset(tmp_path)
    delete_dataset(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    delete_dataset(tmp_path)  # nothing is left to delete


def test_a_kill_while_deleting_leaves_no_finished_dataset_and_no_part_without_recipe(
    tmp_path, monkeypatch
):
    """Whatever was deleted last: meta.yaml goes first, the recipe last."""
    _dataset(tmp_path)
    gone = []
    unlink = Path.unlink
    monkeypatch.setattr(Path, "unlink", lambda p, **how: (gone.append(p.name), unlink(p, **how)))
    delete_dataset(tmp_path)
    assert (gone[0], gone[-1]) == ("meta.yaml", RECIPE)
