"""The store: what is written comes back, and damage anywhere is noticed."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from qs3.errors import DataError, MissingDataError, Qs3Error
from qs3.store import store
from qs3.store.meta import ManifestRow, is_begun, is_finished, read_manifest
from qs3.store.store import open_pointset, write_pointset

CLASSES = ("bed", "chair")


def make(folder, n=6, p=5, seed=0, meta=None, **changes):
    rng = np.random.default_rng(seed)
    rows = [
        ManifestRow(f"{CLASSES[i % 2]}/{i}", CLASSES[i % 2], "train" if i < n - 2 else "test", i)
        for i in range(n)
    ]
    rows.insert(1, ManifestRow("bed/bad", "bed", "train", status="failed", reason="empty mesh"))
    rows.insert(4, ManifestRow("bed/out", "", "test", status="skipped", reason="no mesh"))
    arguments = {
        "name": "tiny",
        "classes": CLASSES,
        "arrays": {
            "points": rng.normal(size=(n, p, 3)),
            "points_clean": list(rng.normal(size=(n, p, 3))),
        },
        "rows": rows,
        "meta": meta if meta is not None else {"config": {"views": 5}},
    }
    return write_pointset(folder, **{**arguments, **changes})


def test_round_trip(tmp_path):
    made = make(tmp_path / "d")
    found = open_pointset(tmp_path / "d")
    expected = np.random.default_rng(0).normal(size=(6, 5, 3)).astype("f4")
    assert isinstance(found.points, np.memmap)
    assert not found.points.flags.writeable
    np.testing.assert_array_equal(found.points, expected)
    assert found.points.dtype == np.float32
    assert found.labels.tolist() == [0, 1, 0, 1, 0, 1]
    assert found.labels.dtype == np.int64
    assert found.splits.tolist() == ["train"] * 4 + ["test"] * 2
    assert found.ids == ("bed/0", "chair/1", "bed/2", "chair/3", "bed/4", "chair/5")
    assert found.classes == CLASSES
    assert found.counts() == {"train": {"bed": 2, "chair": 2}, "test": {"bed": 1, "chair": 1}}
    assert found.meta["config"] == {"views": 5}
    assert found.meta["failed"] == 2
    assert found.sha256 == made.sha256
    clean = open_pointset(tmp_path / "d", "points_clean")
    assert clean.sha256 != found.sha256
    assert not np.array_equal(clean.points, found.points)
    rows = read_manifest(tmp_path / "d")
    assert [row.index for row in rows] == [0, None, 1, 2, None, 3, 4, 5]
    assert rows[1].reason == "empty mesh"


def test_the_smallest_dataset(tmp_path):
    """One point of one cloud of one class, beside an object that failed."""
    rows = [
        ManifestRow("bed/0", "bed", "train"),
        ManifestRow("bed/1", "bed", "train", status="failed", reason="empty"),
    ]
    make(tmp_path / "d", classes=["bed"], arrays={"points": np.ones((1, 1, 3))}, rows=rows)
    found = open_pointset(tmp_path / "d")
    assert (found.classes, found.points.tolist()) == (("bed",), [[[1.0, 1.0, 1.0]]])
    assert (found.meta["clouds"], found.meta["points"], found.meta["failed"]) == (1, 1, 1)


def test_what_is_begun_is_not_finished(tmp_path):
    folder = tmp_path / "d"
    assert not is_begun(folder)
    folder.mkdir()
    assert not is_begun(folder)
    (folder / ".lock").touch()
    assert not is_begun(folder)
    for name in ("points.npy", "-", "zebra"):
        (folder / name).touch()
        assert is_begun(folder)
        (folder / name).unlink()
    make(folder)
    assert is_finished(folder)
    assert not is_begun(folder)


def test_meta_as_people_read_it(tmp_path):
    make(tmp_path / "d", meta={"zebra": "Größe", "apple": "word " * 30})
    text = (tmp_path / "d" / "meta.yaml").read_text()
    keys = [line.split(":")[0] for line in text.splitlines() if line[:1].isalpha()]
    assert keys == [
        *("format", "format_version", "created_by", "name", "classes", "clouds", "points"),
        *("failed", "sha256", "zebra", "apple"),
    ]  # nothing is said of tables where there are none
    assert "Größe" in text
    assert "format_version: 1\n" in text
    assert 90 < max(map(len, text.splitlines()[:-1])) <= 105  # folded at the first word after 100


COLUMNS = ("u", "v", "w", "label")


def with_table(folder, **changes):
    rng = np.random.default_rng(1)
    arrays = {
        "points": rng.normal(size=(6, 5, 3)),
        "clean": rng.normal(size=(6, 5, 3)),
        "seen": rng.normal(size=(6, 5, 4)),
    }
    return make(folder, **{"arrays": arrays, "tables": {"seen": COLUMNS}, **changes})


def test_tables_are_no_variants_and_are_checked(tmp_path):
    made = with_table(tmp_path / "d")
    assert made.meta["tables"] == {"seen": list(COLUMNS)}
    table = np.load(tmp_path / "d" / "seen.npy")
    rng = np.random.default_rng(1)
    rng.normal(size=(2, 6, 5, 3))
    np.testing.assert_array_equal(table, rng.normal(size=(6, 5, 4)).astype("f4"))
    for variant in ("seen", "manifest", "other"):
        with pytest.raises(DataError):
            open_pointset(tmp_path / "d", variant)
    for tables in ({"seen": COLUMNS[:3]}, {"seen": (*COLUMNS, "more")}, {}):
        with pytest.raises(DataError):
            with_table(tmp_path / "e", tables=tables)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        *(
            ("clean", (n, p, c))
            for n, p, c in ((7, 5, 3), (5, 5, 3), (6, 4, 3), (6, 6, 3), (6, 5, 4))
        ),
        ("clean", (6, 5)),
        ("clean", (6, 5, 3, 1)),
        ("points", (7, 5, 3)),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, name, shape):
    with pytest.raises(DataError, match=name):
        make(tmp_path / "d", arrays={"points": np.zeros((6, 5, 3)), name: np.zeros(shape)})


@pytest.mark.parametrize("bad", [(0,), (1, 2), (3,), (4, 5), (5,)])
def test_the_first_cloud_that_is_not_finite_is_named(tmp_path, monkeypatch, bad):
    monkeypatch.setattr(store, "_CHUNK_CLOUDS", 3)
    points = np.zeros((6, 5, 3), dtype="f4")
    points[list(bad), 4, 1] = np.inf
    with pytest.raises(DataError, match=f"cloud {bad[0]} "):
        make(tmp_path / "d", arrays={"points": points})
    make(tmp_path / "d", arrays={"points": np.zeros((6, 5, 3))})
    with open(tmp_path / "d" / "points.npy", "r+b") as file:
        file.seek(-points.nbytes, 2)
        file.write(points.tobytes())
    with pytest.raises(DataError, match=rf"cloud {bad[0]} \(id '{CLASSES[bad[0] % 2]}/{bad[0]}'"):
        open_pointset(tmp_path / "d", verify=False)


def test_same_input_same_bytes_wherever_it_lies(tmp_path):
    a, b = make(tmp_path / "a"), make(tmp_path / "b")
    assert a.sha256 == b.sha256
    for file in ("points.npy", "points_clean.npy", "manifest.csv", "meta.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_content_hash_sees_what_training_sees_and_nothing_else(tmp_path):
    base = make(tmp_path / "0")
    rows = read_manifest(tmp_path / "0")
    moved = [dataclasses.replace(row, origin="elsewhere") for row in rows]
    assert make(tmp_path / "1", rows=moved).sha256 == base.sha256
    assert make(tmp_path / "2", meta={"other": 1}).sha256 == base.sha256
    assert make(tmp_path / "3", seed=1).sha256 != base.sha256
    for change in ({"cls": "chair"}, {"split": "test"}, {"id": "new"}):
        changed = [dataclasses.replace(rows[0], **change), *rows[1:]]
        assert make(tmp_path / "4", rows=changed).sha256 != base.sha256


def test_the_content_hash_is_that_of_its_definition(tmp_path):
    rows = [ManifestRow("bed/é", "bed", "train"), ManifestRow("chair/椅", "chair", "test")]
    made = make(tmp_path, arrays={"points": np.ones((2, 1, 3))}, rows=rows)
    array = hashlib.sha256((tmp_path / "points.npy").read_bytes()).hexdigest()
    seen = [array, ["bed", "chair"], [[row.id, row.cls, row.split] for row in rows]]
    assert made.sha256 == hashlib.sha256(json.dumps(seen).encode("ascii")).hexdigest()


def test_interrupted_rewrite_is_unfinished(tmp_path, monkeypatch):
    make(tmp_path / "d")

    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "write_text", stop)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "d", seed=1)
    monkeypatch.undo()
    assert not is_finished(tmp_path / "d")
    for name in ("d", "e"):
        with pytest.raises(MissingDataError):
            open_pointset(tmp_path / name)
    make(tmp_path / "d", seed=1)
    open_pointset(tmp_path / "d")


@pytest.mark.parametrize(
    "changes",
    [
        {"arrays": {"points": np.zeros((5, 5, 3))}},
        {"arrays": {"points": np.zeros((6, 5, 2))}},
        {"arrays": {"points": np.zeros((6, 0, 3))}},
        {"arrays": {"points": np.full((6, 5, 3), np.nan)}},
        {"arrays": {"points": np.full((6, 5, 3), 1e39)}},
        {"arrays": {"points": [np.zeros((5, 3)), np.zeros((4, 3))]}},
        {"classes": ("bed",)},
        {"rows": [ManifestRow("a", "bed", "dev")]},
        {"rows": [ManifestRow("a", "bed", "test")] * 2},
        {"rows": [ManifestRow("", "bed", "test")]},
        {"rows": [ManifestRow("a", "bed", "test", status="failed")]},
    ],
)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_wrong_input_is_refused_and_nothing_is_finished(tmp_path, changes):
    with pytest.raises(DataError):
        make(tmp_path / "d", **changes)
    assert not is_finished(tmp_path / "d")


def test_not_writable(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Qs3Error):
        make(tmp_path / "file" / "d")


@pytest.mark.parametrize("file", ["points.npy", "manifest.csv", "meta.yaml"])
def test_damage_anywhere_is_noticed(tmp_path, file):
    make(tmp_path / "d", n=3, p=2)
    path = tmp_path / "d" / file
    data = path.read_bytes()
    cut = [data[:size] for size in (*range(0, len(data), 7), len(data) - 1)]
    for changed in (*cut, data + b"\0"):
        path.write_bytes(changed)
        with pytest.raises(DataError, match=file):
            open_pointset(tmp_path / "d", verify=False)  # all this without the arrays' hashes
    for at in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[at] ^= 1 << (at % 8)
        path.write_bytes(flipped)
        with pytest.raises(DataError, match=file):
            open_pointset(tmp_path / "d")
    path.unlink()
    with pytest.raises((DataError, MissingDataError)):
        open_pointset(tmp_path / "d")


def test_other_peoples_array_in_place_of_ours(tmp_path):
    make(tmp_path / "d")
    path = tmp_path / "d" / "points.npy"
    for array in (
        np.zeros((6, 5, 3), "f8"),
        np.zeros((6, 5, 3), ">f4"),
        np.asfortranarray(np.zeros((6, 5, 3), "f4")),
        np.zeros((5, 6, 3), "f4"),
        np.array([{}], dtype=object),
    ):
        np.save(path, array)
        with pytest.raises(DataError, match=r"points\.npy"):
            open_pointset(tmp_path / "d", verify=False)
