"""The store: what is written comes back, and damage anywhere is noticed."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from qs3.errors import DataError, MissingDataError, Qs3Error
from qs3.store import array_files, store
from qs3.store import meta as described
from qs3.store.store import ManifestRow, open_pointset, write_pointset

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
    rows = store.read_manifest(tmp_path / "d", CLASSES)
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
    assert not store.is_begun(folder)
    folder.mkdir()
    assert not store.is_begun(folder)
    (folder / ".lock").touch()
    assert not store.is_begun(folder)
    for name in ("points.npy", "-", "zebra"):
        (folder / name).touch()
        assert store.is_begun(folder)
        (folder / name).unlink()
    make(folder)
    assert store.is_finished(folder)
    assert not store.is_begun(folder)


def test_meta_as_people_read_it(tmp_path):
    make(tmp_path / "d", meta={"zebra": "Größe", "apple": "word " * 30})
    text = (tmp_path / "d" / "meta.yaml").read_text()
    keys = [line.split(":")[0] for line in text.splitlines() if line[:1].isalpha()]
    assert keys == [
        *("format", "format_version", "created_by", "name", "classes", "clouds", "points"),
        *("failed", "sha256", "zebra", "apple"),
    ]  # nothing is said of tables where there are none
    assert "Größe" in text
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
    table, columns = store.open_table(tmp_path / "d", "seen")
    assert columns == COLUMNS
    assert table.shape == (6, 5, 4)
    rng = np.random.default_rng(1)
    rng.normal(size=(2, 6, 5, 3))
    np.testing.assert_array_equal(table, rng.normal(size=(6, 5, 4)).astype("f4"))
    for variant in ("seen", "manifest", "other"):
        with pytest.raises(DataError, match=r"holds the arrays \['clean', 'points'\], not"):
            open_pointset(tmp_path / "d", variant)
    with pytest.raises(DataError, match=r"holds the tables \['seen'\], not 'provenance'"):
        store.open_table(tmp_path / "d")
    path = tmp_path / "d" / "seen.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"seen\.npy is damaged"):
        store.open_table(tmp_path / "d", "seen")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tables": {"seen": COLUMNS, "gone": ("a",)}}, r"tables \['gone'\] are not arrays"),
        ({"tables": {"seen": COLUMNS, "points": ("x",)}}, r"tables \['points'\] are not arrays"),
        ({"tables": {"seen": COLUMNS[:3]}}, r"\(6, 5, 4\), expected \[N, P, 3\]"),
        ({"tables": {"seen": (*COLUMNS, "more")}}, r"\(6, 5, 4\), expected \[N, P, 5\]"),
        ({"tables": {}}, r"array 'seen' .* expected \[N, P, 3\]"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path, changes, message):
    with pytest.raises(DataError, match=message):
        with_table(tmp_path / "d", **changes)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("clean", (7, 5, 3), "6 rows have status ok"),
        ("clean", (5, 5, 3), "6 rows have status ok"),
        ("clean", (6, 4, 3), r"'points' has \(6, 5, 3\)"),
        ("clean", (6, 6, 3), r"'points' has \(6, 5, 3\)"),
        ("clean", (6, 5, 4), r"expected \[N, P, 3\]"),
        ("clean", (6, 5), r"expected \[N, P, 3\]"),
        ("clean", (6, 5, 3, 1), r"expected \[N, P, 3\]"),
        ("points", (7, 5, 3), "6 rows have status ok"),
        ("meta", (6, 5, 3), "cannot be called 'meta'"),
        ("manifest", (6, 5, 3), "cannot be called 'manifest'"),
        ("a/b", (6, 5, 3), "cannot be called 'a/b'"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, name, shape, message):
    arrays = {"points": np.zeros((6, 5, 3)), name: np.zeros(shape)}
    with pytest.raises(DataError, match=message):
        make(tmp_path / "d", arrays=arrays)


@pytest.mark.parametrize("bad", [(0,), (1, 2), (3,), (4, 5), (5,)])
def test_the_first_cloud_that_is_not_finite_is_named(tmp_path, monkeypatch, bad):
    monkeypatch.setattr(array_files, "_CHUNK_CLOUDS", 2)
    points = np.zeros((6, 5, 3), dtype="f4")
    points[list(bad), 4, 1] = np.inf
    with pytest.raises(DataError, match=f"cloud {bad[0]} is not finite"):
        make(tmp_path / "d", arrays={"points": points})
    make(tmp_path / "d", arrays={"points": np.zeros((6, 5, 3))})
    with open(tmp_path / "d" / "points.npy", "r+b") as file:
        file.seek(-points.nbytes, 2)
        file.write(points.tobytes())
    with pytest.raises(DataError, match=rf"cloud {bad[0]} \(id '\w+/{bad[0]}'\) is not finite"):
        open_pointset(tmp_path / "d", verify=False)


def test_the_number_of_clouds_is_checked_against_the_manifest(tmp_path):
    """A manifest and a description that were both written anew, but not for each other."""
    for clouds in (5, 7):
        folder = tmp_path / str(clouds)
        make(folder)
        path = folder / "meta.yaml"
        body = path.read_text().rpartition(described._CHECKSUM)[0]
        body = body.replace("clouds: 6", f"clouds: {clouds}")
        path.write_text(body + described._CHECKSUM + described.sha256_of(body) + "\n")
        with pytest.raises(
            DataError, match=rf"manifest\.csv has 6 rows .* promises {clouds} clouds"
        ):
            open_pointset(folder)


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        ("clouds: 6", "clouds: -6", "has no clouds as"),
        ("clouds: 6", "clouds: 0", "has no clouds as"),
        ("clouds: 6", "clouds: six", "has no clouds as"),
        ("points: 5", "points: -5", "has no points as"),
        ("points: 5", "points: 0", "has no points as"),
        ("points: 5", "points: [5]", "has no points as"),
        ("name: tiny", "named: tiny", "has no name as"),
        ("classes:", "classes: 3\nkinds:", "has no classes as"),
        ("classes:", "classes: []\nkinds:", "has no classes as"),
        ("classes:", "classes: [bed, bed]\nkinds:", "has no classes as"),
        ("sha256:", "sha256: all\nhashes:", "has no sha256 as"),
        ("sha256:", "sha256: [manifest]\nhashes:", "has no sha256 as"),
        ("sha256:", "sha256: {points: abc}\nhashes:", "has no sha256 as"),
        ("clouds: 6", "clouds: 6\ntables: [a]", "has no tables as"),
        ("clouds: 6", "clouds: 6\ntables: {seen: [a]}", "has no tables as"),
        ("clouds: 6", "clouds: [6", "was written by something else"),
        (None, "- 1\n", "was written by something else"),
        (None, "", "was written by something else"),
    ],
)
def test_a_description_of_something_else_with_a_valid_checksum(tmp_path, line, other, message):
    make(tmp_path / "d")
    path = tmp_path / "d" / "meta.yaml"
    body = path.read_text().rpartition(described._CHECKSUM)[0]
    assert line is None or line in body
    body = other if line is None else body.replace(line, other, 1)
    path.write_text(body + described._CHECKSUM + described.sha256_of(body) + "\n")
    with pytest.raises(DataError, match=rf"(?s)meta\.yaml {message}.*generate or import"):
        open_pointset(tmp_path / "d")


def test_same_input_same_bytes_wherever_it_lies(tmp_path):
    a, b = make(tmp_path / "a"), make(tmp_path / "b")
    assert a.sha256 == b.sha256
    for file in ("points.npy", "points_clean.npy", "manifest.csv", "meta.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_content_hash_sees_what_training_sees_and_nothing_else(tmp_path):
    base = make(tmp_path / "0")
    rows = store.read_manifest(tmp_path / "0", CLASSES)
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


def test_hundreds_of_clouds(tmp_path):
    made = make(tmp_path, n=300, p=1, shard_mb=1e-9)  # each in its own file
    assert len(list(tmp_path.glob("points-*.npy"))) == 300
    assert open_pointset(tmp_path).ids == made.ids
    assert len(made.points) == 300


def test_unfinished_and_missing(tmp_path):
    with pytest.raises(MissingDataError, match="no dataset folder"):
        open_pointset(tmp_path / "d")
    make(tmp_path / "d")
    (tmp_path / "d" / "meta.yaml").unlink()
    assert not store.is_finished(tmp_path / "d")
    with pytest.raises(MissingDataError, match="run the same command again"):
        open_pointset(tmp_path / "d")


def test_interrupted_rewrite_is_unfinished(tmp_path, monkeypatch):
    make(tmp_path / "d")

    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "write_text", stop)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "d", seed=1)
    monkeypatch.undo()
    with pytest.raises(MissingDataError):
        open_pointset(tmp_path / "d")
    make(tmp_path / "d", seed=1)
    open_pointset(tmp_path / "d")


def test_unknown_variant(tmp_path):
    make(tmp_path / "d")
    for variant in ("points_noisy", "manifest"):
        with pytest.raises(DataError, match=r"holds the arrays \['points', 'points_clean'\]"):
            open_pointset(tmp_path / "d", variant)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrays": {"points": np.zeros((5, 5, 3))}}, "6 rows have status ok"),
        ({"arrays": {"points": np.zeros((6, 5, 2))}}, r"expected \[N, P, 3\]"),
        ({"arrays": {"points": np.zeros((6, 0, 3))}}, "at least one cloud"),
        ({"arrays": {"points": np.full((6, 5, 3), np.nan)}}, "cloud 0 is not finite"),
        ({"arrays": {"points": np.full((6, 5, 3), 1e39)}}, "cloud 0 is not finite"),
        ({"arrays": {"clean": np.zeros((6, 5, 3))}}, "needs an array 'points'"),
        ({"arrays": {"points": [np.zeros((5, 3)), np.zeros((4, 3))]}}, "several shapes"),
        ({"meta": {"name": 1}}, "may not use the keys"),
        ({"classes": ("bed",)}, "unknown class 'chair'"),
        ({"tables": {"points": ("x", "y", "z")}}, r"tables \['points'\] are not arrays beyond"),
        ({"tables": {"seen": ("a",)}}, r"tables \['seen'\] are not arrays beyond"),
        ({"rows": [ManifestRow("a", "bed", "dev")]}, "unknown split 'dev'"),
        ({"rows": [ManifestRow("a", "bed", "test")] * 2}, "same id is already in line 2"),
        ({"rows": [ManifestRow("", "bed", "test")]}, "id is empty"),
        ({"rows": [ManifestRow("a", "bed", "test", status="failed")]}, "has a reason"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_wrong_input_is_refused_and_nothing_is_finished(tmp_path, changes, message):
    with pytest.raises(DataError, match=message):
        make(tmp_path / "d", **changes)
    assert not store.is_finished(tmp_path / "d")


def test_not_writable(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Qs3Error, match="cannot make the folder"):
        make(tmp_path / "file" / "d")


@pytest.mark.parametrize("file", ["points.npy", "manifest.csv", "meta.yaml"])
def test_truncation_anywhere_is_noticed(tmp_path, file):
    make(tmp_path / "d", n=3, p=2)
    path = tmp_path / "d" / file
    data = path.read_bytes()
    for size in range(0, len(data), 7):
        path.write_bytes(data[:size])
        with pytest.raises(DataError, match=file):
            open_pointset(tmp_path / "d", verify=False)  # all this without the arrays' hashes
    path.write_bytes(data[:-1])
    with pytest.raises(DataError, match=file):
        open_pointset(tmp_path / "d", verify=False)
    path.write_bytes(data + b"\0")
    with pytest.raises(DataError, match=file):
        open_pointset(tmp_path / "d", verify=False)


@pytest.mark.parametrize("file", ["points.npy", "manifest.csv", "meta.yaml"])
def test_a_flipped_bit_anywhere_is_noticed(tmp_path, file):
    make(tmp_path / "d", n=3, p=2)
    path = tmp_path / "d" / file
    data = path.read_bytes()
    for at in range(0, len(data), 3):
        changed = bytearray(data)
        changed[at] ^= 1 << (at % 8)
        path.write_bytes(changed)
        with pytest.raises(DataError, match=file):
            open_pointset(tmp_path / "d")


def test_a_missing_file_is_named(tmp_path):
    for file in ("points.npy", "manifest.csv"):
        make(tmp_path / "d")
        (tmp_path / "d" / file).unlink()
        with pytest.raises(DataError, match=f"{file} cannot be read"):
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


def test_nan_on_disk_is_found_without_the_hash(tmp_path):
    make(tmp_path / "d")
    path = tmp_path / "d" / "points.npy"
    data = bytearray(path.read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"cloud 5 \(id 'chair/5'\) is not finite"):
        open_pointset(tmp_path / "d", verify=False)


def test_another_version_of_the_format(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(described, "FORMAT_VERSION", 2)
        make(tmp_path / "d")
    with pytest.raises(DataError, match="format version 2, this qs3 reads 1"):
        open_pointset(tmp_path / "d")
    with monkeypatch.context() as patch:
        patch.setattr(described, "FORMAT_VERSION", 0)
        make(tmp_path / "d")
    with pytest.raises(DataError, match="format version 0, this qs3 reads 1"):
        open_pointset(tmp_path / "d")
