"""Clouds in several files answer as one array would; a dataset is the same however it is cut."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datamodules.fps_cache import prepare
from qs3.errors import DataError
from qs3.store import array_files, meta
from qs3.store.array_files import Column, clouds_each, shard_name, write_array
from qs3.store.sharded import ShardedArray, picked
from qs3.store.store import ManifestRow, has_variant, open_pointset, open_table, write_pointset

CONF = Path(__file__).parents[2] / "conf"
ROWS = [
    ManifestRow(f"{cls}/{i}", cls, "train" if i % 3 else "test")
    for cls in ("bed", "chair")
    for i in range(5)
]
POINTS = np.random.default_rng(0).normal(size=(10, 7, 3)).astype(np.float32)
SEEN = np.random.default_rng(1).normal(size=(10, 7, 5)).astype(np.float32)


def cut(array: np.ndarray, each: int) -> ShardedArray:
    return ShardedArray([array[i : i + each] for i in range(0, len(array), each)])


@given(
    each=st.integers(1, 11),
    rows=st.lists(st.integers(-10, 9), max_size=12),
    bounds=st.tuples(st.integers(-12, 12), st.integers(-12, 12), st.sampled_from([1, 2, 3, -1])),
)
def test_it_answers_as_the_array_would(each, rows, bounds):
    shards, index = cut(POINTS, each), np.array(rows, dtype=np.int64)
    assert shards.shape == POINTS.shape
    assert (len(shards), shards.ndim, shards.dtype) == (10, POINTS.ndim, POINTS.dtype)
    np.testing.assert_array_equal(np.asarray(shards), POINTS)
    np.testing.assert_array_equal(np.stack(list(shards)), POINTS)
    np.testing.assert_array_equal(shards[index], POINTS[index])
    np.testing.assert_array_equal(shards[index, 0], POINTS[index, 0])
    np.testing.assert_array_equal(shards[index, :, 1], POINTS[index, :, 1])
    for i in rows:
        np.testing.assert_array_equal(shards[i], POINTS[i])
        np.testing.assert_array_equal(shards[i, :, 2], POINTS[i, :, 2])
    chosen = slice(*bounds)
    np.testing.assert_array_equal(np.asarray(shards[chosen]), POINTS[chosen])
    np.testing.assert_array_equal(shards[chosen, 3], POINTS[chosen, 3])
    mask = np.isin(np.arange(10), rows)
    np.testing.assert_array_equal(shards[mask], POINTS[mask])
    np.testing.assert_array_equal(np.asarray(shards.at(mask)), POINTS[mask])
    if rows:  # of a part of a part
        np.testing.assert_array_equal(np.asarray(shards.at(index).at(slice(1, 5))),
                                      POINTS[index][1:5])  # fmt: skip


def test_a_slice_reads_nothing_and_the_rest_cannot_be_written():
    shards = cut(POINTS.copy(), 4)
    assert isinstance(shards[2:9], ShardedArray)
    assert isinstance(shards.at(np.array([1, 8])), ShardedArray)
    assert np.asarray(shards).dtype == np.float32
    assert shards.__array__(np.float64).dtype == np.float64  # numpy would mend it afterwards
    for wrong in (10, -11):
        with pytest.raises(IndexError):
            shards[wrong]
    with pytest.raises(IndexError):
        shards[np.array([3, 10])]
    with pytest.raises(TypeError):
        shards[0] = 1


@pytest.mark.parametrize("each", [1, 3, 10])
@pytest.mark.parametrize(
    "key",
    [
        np.s_[:3, [0, 1, 2]],  # as many of either: not paired
        np.s_[:, [0, 2]],
        np.s_[::-2, :, [2, 0]],
        np.s_[1:7, np.arange(7) > 4, 1],
        np.s_[2:9, [[0, 1], [2, 3]], [0, 2]],
        np.s_[[0, 9, 4], [1, 1, 6]],  # paired
        np.s_[[[0], [9]], [1, 1, 6]],
        np.s_[np.array([8, 1]), :, [0, 2]],
        np.s_[np.arange(10) % 2 == 0, [0, 1, 2, 3, 4]],
        np.s_[-2, [1, 2]],
        np.s_[-2, :, [1, 2]],
        np.s_[..., 0],
        np.s_[..., [0, 2]],
        np.s_[..., 1:3, :],
        np.s_[3:5, None, 1:3],
        np.s_[3:5, ..., -1],
        np.s_[[5, 2], ..., -1],
    ],
)
def test_arrays_behind_the_first_place_are_those_of_numpy(each, key):
    expected, found = POINTS[key], np.asarray(cut(POINTS, each)[key])
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found, expected)


@given(each=st.integers(1, 11), seed=st.integers(0, 99), batch=st.integers(0, 6))
def test_points_of_a_batch_are_picked_as_by_indexing(each, seed, batch):
    rng = np.random.default_rng(seed)
    clouds, points = rng.integers(10, size=batch), rng.integers(7, size=(batch, 4)).astype(np.int16)
    expected = POINTS[clouds[:, None], points]
    np.testing.assert_array_equal(picked(POINTS, clouds, points), expected)
    np.testing.assert_array_equal(cut(POINTS, each).pick(clouds, points), expected)


def written(folder, each: int, **changes):
    """A dataset cut at so many clouds, of which the widest array has 140 bytes."""
    arguments = {
        "name": "cut",
        "classes": ("bed", "chair"),
        "arrays": {"points": POINTS, "points_clean": -POINTS, "provenance": SEEN},
        "rows": ROWS,
        "meta": {},
        "tables": {"provenance": ("a", "b", "c", "d", "e")},
        **changes,
    }
    return write_pointset(folder, shard_mb=(each + 0.5) * 140e-6, **arguments)


@given(each=st.integers(1, 12), lazily=st.booleans())
@settings(max_examples=12)
def test_a_dataset_is_the_same_however_it_is_cut(tmp_path_factory, each, lazily):
    folder = tmp_path_factory.mktemp("d")
    one = written(folder / "one", 10)
    assert (folder / "one" / "points.npy").is_file()
    arrays = {"points": POINTS, "points_clean": -POINTS, "provenance": SEEN}
    if lazily:
        arrays = {key: [cloud.astype(np.float64) for cloud in of] for key, of in arrays.items()}
    written(folder / "many", each, arrays=arrays)
    many = open_pointset(folder / "many")
    assert many.sha256 == one.sha256
    assert isinstance(many.points, ShardedArray) == (each < 10)
    np.testing.assert_array_equal(np.asarray(many.points), POINTS)
    np.testing.assert_array_equal(
        np.asarray(open_pointset(folder / "many", "points_clean").points), -POINTS
    )
    table, columns = open_table(folder / "many")
    assert columns == ("a", "b", "c", "d", "e")
    np.testing.assert_array_equal(np.asarray(table), SEEN)
    for split in ("train", "test"):
        ours, theirs = many.split(split), one.split(split)
        assert ours.ids == theirs.ids
        np.testing.assert_array_equal(np.asarray(ours.points), theirs.points)
    files = sorted(path.name for path in (folder / "many").glob("points*.npy"))
    if each < 10:
        assert files[0] == "points-00000.npy"
        assert len(files) == 2 * -(-10 // each)
        part = np.load(folder / "many" / "points-00000.npy", allow_pickle=False)
        np.testing.assert_array_equal(part, POINTS[:each])  # any tool reads a shard
    else:
        assert files == ["points.npy", "points_clean.npy"]


def test_batches_are_those_of_one_file(tmp_path):
    one, many = written(tmp_path / "one", 10), written(tmp_path / "many", 3)
    for count in (4, 7):  # of 7 points: chosen, and all
        a, b = (
            prepare(data.split("train").points, count, starts=2, cache_dir=tmp_path / "cache",
                    key=data.sha256)
            for data in (one, many)
        )  # fmt: skip
        assert np.array_equal(a.all(), b.all())
        assert np.array_equal(a.radius, b.radius)


def test_a_new_cut_leaves_nothing_of_the_old(tmp_path):
    others = {"points-extra.npy", "points-noisy-00000.npy", "points_noisy-00007.npy"}
    others |= {"points_own.npy", "points_own-00000.npy", "older-00001.npy"}
    for name in others:
        (tmp_path / name).touch()
    for each in (3, 10, 4):
        written(tmp_path, each)
        shards = [shard_name("points", i) for i in range(-(-10 // each))]
        expected = {"points.npy"} if each == 10 else set(shards)
        found = {path.name for path in tmp_path.glob("*.npy")}
        assert others < found
        of_clouds = {name for name in found - others if name.startswith("points")}
        assert {name for name in of_clouds if "clean" not in name} == expected
        assert has_variant(tmp_path, "points")
        assert has_variant(tmp_path, "points_clean")
        assert not has_variant(tmp_path, "points_noisy")
    (tmp_path / "meta.yaml").unlink()
    assert not has_variant(tmp_path, "points")


@pytest.mark.parametrize("damage", ["flip", "cut", "gone", "swap"])
def test_a_damaged_shard_is_named(tmp_path, damage):
    written(tmp_path, 3)
    path, other = tmp_path / "points-00002.npy", tmp_path / "points-00001.npy"
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[-1] ^= 1
        path.write_bytes(data)
    elif damage == "cut":
        path.write_bytes(data[:-1])
    elif damage == "gone":
        path.unlink()
    else:
        path.write_bytes(other.read_bytes())
    with pytest.raises(DataError, match=r"points-00002\.npy"):
        open_pointset(tmp_path)
    if damage != "gone":
        written(tmp_path, 3)
        (tmp_path / "points-00003.npy").write_bytes(b"")
        with pytest.raises(DataError, match=r"points-00003\.npy has 0 bytes"):
            open_pointset(tmp_path, verify=False)


@pytest.mark.parametrize(
    "shards",
    [
        {"clouds": 9},
        {"clouds": 0, "sha256": {"points": ["a"] * 2, "points_clean": ["a"] * 2}},
        {"clouds": True, "sha256": {"points": ["a"] * 10, "points_clean": ["a"] * 10}},
        {"clouds": 9, "sha256": {"points": ["a"] * 2}},
        {"clouds": 9, "sha256": {"points": ["a"] * 3, "points_clean": ["a"] * 2}},
        {"clouds": 9, "sha256": {"points": ["a"] * 2, "points_clean": [1] * 2}},
        {"clouds": 9, "sha256": {"points": "aa", "points_clean": ["a"] * 2}},
        {"clouds": 9, "sha256": {"points": ["a"] * 2, "points_clean": ["a"]}},
        {"clouds": 9, "sha256": {k: ["a"] * 2 for k in ("points", "points_clean", "other")}},
        {"clouds": 9, "sha256": {k: ["a"] * 2 for k in ("points", "points_clean")}, "each": 9},
        ["points"],
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path, shards):
    arrays = {"points": POINTS, "points_clean": -POINTS}
    written(tmp_path, 5, arrays=arrays, tables=None)  # each has 84 bytes

    document = yaml.safe_load((tmp_path / "meta.yaml").read_text())
    assert document["shards"]["clouds"] == 9
    text = yaml.safe_dump({**document, "shards": shards}, sort_keys=False)
    (tmp_path / "meta.yaml").write_text(
        f"{text}# sha256 of the lines above: {meta.sha256_of(text)}\n"
    )
    with pytest.raises(DataError, match="has no shards as `write_pointset` writes it"):
        open_pointset(tmp_path)


def test_where_a_file_ends():
    assert clouds_each(1024, (1, 2048, 3)) == 41_666
    assert clouds_each(1, (1, 2048, 3)) == 40
    assert clouds_each(1, (1, 1_000_000, 3)) == 1  # one cloud is never cut
    assert clouds_each(1000, (1, 1, 1)) == 250_000_000
    assert clouds_each(array_files.SHARD_MB, (9, 2048, 3)) == 41_666
    default = yaml.safe_load((CONF / "generate.yaml").read_text())["shard_mb"]
    assert default == array_files.SHARD_MB


class Asked:
    """Clouds that are made when they are asked for."""

    def __init__(self, n: int, p: int) -> None:
        self.n, self.p = n, p

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, key):
        if isinstance(key, slice):
            return [self[i] for i in range(self.n)[key]]
        return np.full((self.p, 3), key, dtype=np.float32)


def test_writing_and_reading_need_no_memory_for_the_whole(tmp_path):
    """60 MB of clouds, in files of at most 5 MB, by 13 MB: a chunk of 512 clouds and its copies."""
    n, p = 5000, 1000
    column = Column("made", "points", Asked(n, p))
    tracemalloc.start()
    try:
        made = write_array(tmp_path, "points", column, clouds_each(5, column.shape))
        _, peak = tracemalloc.get_traced_memory()
        assert peak < 20e6
        about = {
            "clouds": n,
            "points": p,
            "sha256": {"points": made.sha256},
            "shards": {"clouds": clouds_each(5, column.shape), "sha256": {"points": made.shards}},
        }
        tracemalloc.reset_peak()
        found = array_files.open_array(tmp_path, "points", about, 3, verify=True)
        array_files.check_finite(tmp_path, found, [str(i) for i in range(n)])
        clouds = prepare(found, p)
        for start in range(0, n, 16):
            rows = np.arange(start, min(start + 16, n))
            assert (found[rows, 0, 0] == rows).all()
        assert len(clouds) == n
        _, peak = tracemalloc.get_traced_memory()
        assert peak < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("n", [1, 2])
def test_the_first_cloud_gives_the_shape(n):
    assert Column("made", "points", Asked(n, 4)).shape == (n, 4, 3)
    assert Column("made", "points", []).shape == (0,)


def test_what_was_written_cannot_be_changed():
    with pytest.raises(AttributeError):
        array_files.Written("a", ()).sha256 = "b"


def test_clouds_of_several_shapes_are_refused_when_they_are_read(tmp_path):
    class Uneven(Asked):
        def __getitem__(self, key):
            if isinstance(key, slice):
                return super().__getitem__(key)
            return np.zeros((self.p + (key == 7), 3))

    with pytest.raises(DataError, match=r"several shapes \[\(4, 3\), \(5, 3\)\]"):
        Column("made", "points", Uneven(9, 4)).check_finite()
