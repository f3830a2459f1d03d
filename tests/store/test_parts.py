"""Parts of unfinished datasets: one that is damaged is named, however it is."""

from __future__ import annotations

import hashlib
import io
import re
import zipfile

import numpy as np
import pytest

from qs3.errors import ConfigError, DataError
from qs3.store.parts import PartFiles
from tests.fixtures.harm import Harm


def _zip(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, data)
    return file.getvalue()


def test_nothing_is_unpickled(tmp_path):
    parts = PartFiles(tmp_path, "path")
    parts.begin({"a": 1})
    parts.write("x", {"n": 1}, {"points": np.zeros(3)})
    (path,) = tmp_path.rglob("x.npz")
    with np.load(path, allow_pickle=False) as file:
        harmful = {name: np.array(Harm(tmp_path / "harm"), dtype=object) for name in file.files}
    np.savez(path, **harmful)
    with pytest.raises(DataError, match=r"x\.npz is damaged .*pickle"):
        parts.read("x")
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        _zip("points.npy", b""),
        _zip("note.npy", b"\x93NUMPY\x01\x00\x06\x00((((((" + bytes(9)),
        _zip("xote.npy", b"").replace(b"xote", b"\0ote"),
        _zip("note.npy", b"\x93NUMPY"),
    ],
    ids=["empty", "cut", "no note", "a header of brackets", "a name of nothing", "a cut header"],
)
def test_a_damaged_part_is_named(content, tmp_path):
    parts = PartFiles(tmp_path, "path")
    parts.begin({"a": 1})
    parts.write("x", {"n": 1}, {"points": np.zeros(3)})
    assert parts.read("x")[0] == {"n": 1}
    (path,) = tmp_path.rglob("x.npz")
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.npz is damaged .* delete it and run again"):
        parts.read("x")


BEGUN = {
    "settings": {"sensor": {"baseline_m": 0.1, "name": "a"}, "views": 5},
    "objects": ["a", "b", "c"],
    "poses": [1, 2],
    "looks": [1, 2],
    "note": "x",
}


def refusal(folder, recipe):
    with pytest.raises(ConfigError) as refused:
        PartFiles(folder, "out").check(recipe)
    first, *lines, last = str(refused.value).split("\n")
    assert first == (
        f"{folder} was made with other settings or versions, and mixing them is refused:"
    )
    assert last == "Use the same settings, another out, or force=true to start over."
    return lines


def test_what_differs_is_named_by_its_key(tmp_path):
    PartFiles(tmp_path, "out").begin(BEGUN)
    PartFiles(tmp_path, "out").check(BEGUN)
    PartFiles(tmp_path, "out").check({**BEGUN, "poses": (1, 2)})  # as JSON has it
    other = {"sensor": {"baseline_m": 0.2, "name": "a"}, "views": 5}
    assert refusal(tmp_path, {**BEGUN, "settings": other}) == [
        "  settings.sensor.baseline_m: 0.1 there, 0.2 now"
    ]
    assert refusal(tmp_path, {**BEGUN, "settings": {"sensor": "none", "more": 1}}) == [
        '  settings.sensor: {"baseline_m": 0.1, "name": "a"} there, "none" now',
        '  settings.views: 5 there, "nothing" now',
        '  settings.more: "nothing" there, 1 now',
    ]
    changed = {**BEGUN, "poses": [2], "objects": ["a"]}
    assert refusal(tmp_path, changed) == [
        "  objects: 3, among them 'b' there, 1 now",
        "  poses: [1, 2] there, [2] now",
    ]
    for key in ("poses", "looks"):  # before and after "objects"
        assert refusal(tmp_path, {**BEGUN, key: [2, 1]}) == [f"  {key}: [1, 2] there, [2, 1] now"]
    short, long = "y" * 78, "y" * 79  # of which the quotes make 80 and 81 letters
    assert refusal(tmp_path, {**BEGUN, "note": short}) == [f'  note: "x" there, "{short}" now']
    assert refusal(tmp_path, {**BEGUN, "note": long}) == [f'  note: "x" there, "{long[:76]}... now']


@pytest.mark.parametrize(
    ("now", "said"),
    [
        (["a", "e", "d"], "3, among them 'b' there, 3, among them 'd' now"),
        (["a"], "3, among them 'b' there, 1 now"),
        ("all", '["a", "b", "c"] there, "all" now'),
    ],
)
def test_other_objects_are_not_other_settings(tmp_path, now, said):
    PartFiles(tmp_path, "out").begin(BEGUN)
    message = f"made from other objects: {said}. A dataset is of one set of objects"
    with pytest.raises(ConfigError, match=re.escape(message)):
        PartFiles(tmp_path, "out").check({**BEGUN, "objects": now})


def test_a_dozen_differences_are_enough(tmp_path):
    PartFiles(tmp_path, "out").begin({f"k{i:02}": 0 for i in range(20)})
    lines = refusal(tmp_path, {f"k{i:02}": i for i in range(20)})
    assert [line.split(":")[0] for line in lines] == [f"  k{i:02}" for i in range(1, 13)]


@pytest.mark.parametrize("content", [None, b"{", b"\xff", b"[" * 200_000])
def test_a_recipe_that_cannot_be_read_is_named(tmp_path, content):
    parts = PartFiles(tmp_path, "out")
    assert not parts.have_recipe
    if content is not None:
        (tmp_path / "recipe.json").write_bytes(content)
        assert parts.have_recipe
    with pytest.raises(DataError, match=r"recipe\.json cannot be read .*: use force=true"):
        parts.check({})


def test_a_node_knows_whether_it_sees_the_same_dataset(tmp_path):
    parts = PartFiles(tmp_path, "out")
    with pytest.raises(DataError, match=r"does not see .*No such file.*engine\.shared_disk=false"):
        parts.check_there("")
    assert parts.are_there is False
    parts.begin(BEGUN)
    assert parts.are_there is True
    digest = hashlib.sha256((tmp_path / "recipe.json").read_bytes()).hexdigest()
    assert parts.recipe_sha256() == digest
    parts.check_there(digest)
    for other in ("0" * 64, "f" * 64):
        with pytest.raises(DataError, match="was begun anew with other settings while"):
            parts.check_there(other)


def test_arrays_are_read_when_they_are_asked_for(tmp_path):
    parts = PartFiles(tmp_path, "out")
    parts.begin({})
    arrays = {"a": np.arange(3), "note_too": np.ones(2), "z": np.zeros(1)}
    parts.write("one", {"x": 1}, arrays)
    note, found = parts.open("one")
    assert (note, list(found), len(found)) == ({"x": 1}, ["a", "note_too", "z"], 3)
    np.testing.assert_array_equal(found["a"], [0, 1, 2])
    assert list(found.only(["z"])) == ["z"]
    for key in ("note", "b"):
        with pytest.raises(KeyError):
            found[key]
    with pytest.raises(KeyError):
        found.only(["z"])["a"]
    data = bytearray((tmp_path / "parts" / "one.npz").read_bytes())
    data[data.index(b"\x93NUMPY") + 130] ^= 1
    (tmp_path / "parts" / "one.npz").write_bytes(data)
    with pytest.raises(DataError, match=r"one\.npz is damaged .*: delete it and run again"):
        dict(parts.open("one")[1])
    harmful = np.array([object()], dtype=object)
    np.savez(tmp_path / "parts" / "two.npz", note=harmful, allow_pickle=True)
    with pytest.raises(DataError, match=r"two\.npz is damaged"):
        parts.open("two")
