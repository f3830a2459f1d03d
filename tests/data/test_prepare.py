from __future__ import annotations

import numpy as np
import pytest

import qs3.geometry.sampling
from qs3.data.prepare import prepare
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
