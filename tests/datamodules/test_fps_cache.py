from __future__ import annotations

import errno
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import qs3.datamodules.fps_cache
import qs3.utils.files
from qs3.datamodules.fps_cache import prepare, remove_old_leftovers
from qs3.datamodules.fps_samples import sample
from qs3.errors import ConfigError
from qs3.geometry.sampling import unit_ball

CLOUDS = np.random.default_rng(0).normal(size=(3, 40, 3)).astype(np.float32) + 5


def numbers(folder: Path | None = None, count: int = 10, starts: int = 2, key: str = "key"):
    """Indices of `prepare`; and whether they were sampled anew."""
    calls = []
    real = qs3.datamodules.fps_cache.sample_all

    def counted(*args):
        calls.append(args)
        return real(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(qs3.datamodules.fps_cache, "sample_all", counted)
        clouds = prepare(CLOUDS, count, starts=starts, cache_dir=folder, key=key)
    return clouds.order, bool(calls)


def cached(folder: Path) -> Path:
    (file,) = folder.glob("*.npy")
    return file


def test_in_the_unit_ball_about_the_centroid_of_all_points():
    whole = prepare(CLOUDS, 40).all().numpy()
    assert np.allclose(whole.mean(axis=1), 0, atol=1e-6)
    assert np.allclose(np.linalg.norm(whole, axis=2).max(axis=1), 1)
    part = prepare(CLOUDS, 10).all().numpy()
    for cloud, sampled in zip(whole, part, strict=True):
        assert all((cloud == point).all(axis=1).any() for point in sampled)


def test_evaluation_sees_the_sample_from_point_0():
    clouds = prepare(CLOUDS, 10, starts=3)
    for stored, seen in zip(CLOUDS, clouds.all().numpy(), strict=True):
        ball = unit_ball(stored)
        assert np.array_equal(seen[0], ball[0])
        assert np.array_equal(seen, ball[sample(stored[None], 10, 1)[0, 0]])


def test_the_cached_samples_serve_both_scales(tmp_path):
    """Farthest points do not depend on a cloud's size, so one file holds those of both."""
    ball = prepare(CLOUDS, 10, starts=2, cache_dir=tmp_path, key="key")
    file = cached(tmp_path)
    before = file.read_bytes()
    metres = prepare(CLOUDS, 10, starts=2, cache_dir=tmp_path, key="key", scale="metres")
    assert cached(tmp_path).read_bytes() == before
    assert np.array_equal(metres.order, ball.order)
    for i, cloud in enumerate(CLOUDS):
        centred = cloud - cloud[0] - (cloud - cloud[0]).mean(axis=0)
        # sampled anew in metres, by the slow and obvious way
        chosen, nearest = [0], np.full(len(centred), np.inf)
        for _ in range(9):
            nearest = np.minimum(nearest, np.linalg.norm(centred - centred[chosen[-1]], axis=1))
            chosen.append(int(nearest.argmax()))
        assert metres.order[i, 0].tolist() == chosen
        assert np.array_equal(metres.all().numpy()[i], centred[chosen])


def test_nothing_to_choose_where_all_points_are_taken(tmp_path):
    clouds = prepare(CLOUDS, 40, starts=4, cache_dir=tmp_path)
    assert clouds.starts == 1
    assert list(tmp_path.iterdir()) == []


def test_no_more_starts_than_points():
    assert prepare(CLOUDS[:, :3], 2, starts=5).starts == 3


def test_cached_as_a_map(tmp_path):
    first, sampled = numbers(tmp_path)
    assert sampled
    again, sampled = numbers(tmp_path)
    assert not sampled
    assert isinstance(again, np.memmap)
    assert np.array_equal(first, again)
    assert np.array_equal(first, sample(CLOUDS, 10, 2))


@pytest.mark.parametrize("other", [{"count": 9}, {"starts": 3}, {"key": "other"}])
def test_other_settings_have_another_file(tmp_path, other):
    numbers(tmp_path)
    before = cached(tmp_path).read_bytes()
    first = cached(tmp_path)
    assert numbers(tmp_path, **other)[1]
    assert first.read_bytes() == before


@pytest.mark.parametrize(("what", "now"), [("_VERSION", 3), ("version", lambda name: "0.0")])
def test_the_cache_of_another_version_or_fpsample_is_redone(tmp_path, monkeypatch, what, now):
    numbers(tmp_path)
    monkeypatch.setattr(qs3.datamodules.fps_cache, what, now)
    assert numbers(tmp_path)[1]


DAMAGES = {
    "empty": lambda data: b"",
    "header only": lambda data: data[:100],
    "truncated": lambda data: data[:-50],
    "without checksum": lambda data: data[:-32],
    "one bit": lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
    "something else": lambda data: b"not an array, but long enough for a checksum" * 3,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_cache_is_redone(tmp_path, caplog, damage):
    first, _ = numbers(tmp_path)
    file = cached(tmp_path)
    sound, expected = file.read_bytes(), np.array(first)
    file.unlink()  # as writers do: the old map stays what it was
    file.write_bytes(damage(sound))
    order, sampled = numbers(tmp_path)
    assert sampled
    assert np.array_equal(order, expected)
    assert file.read_bytes() == sound
    assert caplog.text.count(str(file)) == 1  # it is looked at twice, before the lock and in it


def test_a_cache_of_other_clouds_under_this_name_is_redone(tmp_path):
    numbers(tmp_path, key="other")
    (old,) = tmp_path.glob("other-*.npy")
    numbers(tmp_path)
    (file,) = tmp_path.glob("key-*.npy")
    os.replace(old, file)
    assert numbers(tmp_path)[1]


def test_too_many_points():
    with pytest.raises(ConfigError, match=r"data\.points is 41.*40 points"):
        prepare(CLOUDS, 41)


def test_a_file_where_the_cache_should_be(tmp_path, caplog):
    (tmp_path / "cache").write_text("")
    order, sampled = numbers(tmp_path / "cache")
    assert sampled
    assert np.array_equal(order, sample(CLOUDS, 10, 2))
    assert "data.cache_dir=null" in caplog.text


def test_a_full_disk_is_a_warning(tmp_path, monkeypatch, caplog):
    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(qs3.utils.files, "_flush", full)
    order, _ = numbers(tmp_path)
    assert np.array_equal(order, sample(CLOUDS, 10, 2))
    assert "No space left" in caplog.text
    assert list(tmp_path.glob("*.npy")) == list(tmp_path.glob(".*.tmp*")) == []


def test_interrupted_and_done_again(tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(qs3.datamodules.fps_cache, "sample_all", stop)
        with pytest.raises(KeyboardInterrupt):
            prepare(CLOUDS, 10, starts=2, cache_dir=tmp_path, key="key")
    with monkeypatch.context() as patch:
        patch.setattr(qs3.datamodules.fps_cache.np, "save", stop)  # in the middle of writing
        with pytest.raises(KeyboardInterrupt):
            prepare(CLOUDS, 10, starts=2, cache_dir=tmp_path, key="key")
    assert list(tmp_path.glob("*.npy")) == []
    order, _ = numbers(tmp_path)
    assert np.array_equal(order, sample(CLOUDS, 10, 2))


def test_of_two_runs_that_start_together_one_samples(tmp_path, monkeypatch):
    calls = []

    def slow(*args):
        calls.append(args)
        time.sleep(0.3)
        return sample(*args)

    monkeypatch.setattr(qs3.datamodules.fps_cache, "sample_all", slow)
    with ThreadPoolExecutor(2) as both:
        runs = [
            both.submit(prepare, CLOUDS, 10, starts=2, cache_dir=tmp_path, key="key")
            for _ in range(2)
        ]
    assert len(calls) == 1
    np.testing.assert_array_equal(runs[0].result().order, runs[1].result().order)


def test_only_old_leftovers_are_removed(tmp_path):
    numbers(tmp_path)
    kept = cached(tmp_path)
    names = (f".{kept.name}.old.tmp.npy", f".{kept.name}.new.tmp.npy", ".other.old.tmp.csv")
    for name in names:
        (tmp_path / name).write_text("")
        if "old" in name:
            os.utime(tmp_path / name, (1, 1))
    remove_old_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {".lock", kept.name, *names[1:]}
    remove_old_leftovers(tmp_path / "absent")
