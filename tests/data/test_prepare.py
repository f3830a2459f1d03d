from __future__ import annotations

import os

import numpy as np
import pytest

import qs3.geometry.sampling
from qs3.data.prepare import prepare, remove_old_leftovers
from qs3.errors import ConfigError

CLOUDS = np.random.default_rng(0).normal(size=(3, 40, 3)).astype(np.float32) + 5


def test_in_the_unit_ball_about_the_centroid_of_all_points():
    whole = prepare(CLOUDS, 40)
    assert np.allclose(whole.mean(axis=1), 0, atol=1e-6)
    assert np.allclose(np.linalg.norm(whole, axis=2).max(axis=1), 1)
    part = prepare(CLOUDS, 10)
    for cloud, sampled in zip(whole, part, strict=True):
        assert all((cloud == point).all(axis=1).any() for point in sampled)


def test_cached(tmp_path, monkeypatch):
    first = prepare(CLOUDS, 10, tmp_path, "key")
    monkeypatch.setattr(qs3.geometry.sampling, "unit_ball", None)
    assert np.array_equal(prepare(CLOUDS, 10, tmp_path, "key"), first)


def test_damaged_cache_is_redone(tmp_path):
    first = prepare(CLOUDS, 10, tmp_path, "key")
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:50])
    assert np.array_equal(prepare(CLOUDS, 10, tmp_path, "key"), first)


def test_too_many_points():
    with pytest.raises(ConfigError, match=r"data\.points is 41.*40 points"):
        prepare(CLOUDS, 41)


def test_a_file_where_the_cache_should_be(tmp_path, caplog):
    (tmp_path / "cache").write_text("")
    assert np.array_equal(prepare(CLOUDS, 10, tmp_path / "cache", "key"), prepare(CLOUDS, 10))
    assert "data.cache_dir=null" in caplog.text


def test_only_old_leftovers_are_removed(tmp_path):
    prepare(CLOUDS, 10, tmp_path, "key")
    (kept,) = tmp_path.iterdir()
    names = (f".{kept.name}.old.tmp.npy", f".{kept.name}.new.tmp.npy", ".other.old.tmp.csv")
    for name in names:
        (tmp_path / name).write_text("")
        if "old" in name:
            os.utime(tmp_path / name, (1, 1))
    remove_old_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {kept.name, *names[1:]}
    remove_old_leftovers(tmp_path / "absent")
