"""Farthest points: which they are, that threads change nothing, and their cache."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from qs3.datamodules import fps_samples
from qs3.datamodules.fps_samples import farthest_points, sample, sample_all, start_points
from qs3.errors import ConfigError
from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball

CLOUDS = np.random.default_rng(0).normal(size=(7, 50, 3)).astype(np.float32) + 5


def test_starts_are_a_function_of_the_cloud_and_differ():
    first = start_points(CLOUDS[0], 6)
    assert first[0] == 0
    assert len(set(first)) == 6
    assert start_points(CLOUDS[0].copy(), 3) == first[:3]
    assert start_points(CLOUDS[1], 6) != first
    assert sorted(start_points(CLOUDS[0, :4], 4)) == [0, 1, 2, 3]  # as many as there are points


def test_each_sample_is_farthest_point_sampling_from_its_start():
    order = sample(CLOUDS, 10, 3)
    assert order.shape == (7, 3, 10)
    assert order.dtype == np.int16
    for cloud, samples in zip(CLOUDS, order, strict=True):
        ball = unit_ball(cloud)
        for chosen, start in zip(samples, start_points(cloud, 3), strict=True):
            assert np.array_equal(chosen, farthest_point_sampling_np(ball, 10, start))


def test_threads_do_not_change_the_result(monkeypatch):
    monkeypatch.setattr(fps_samples, "_CHUNK", 2)
    one = sample(CLOUDS, 10, 3)
    assert np.array_equal(sample_all(CLOUDS, 10, 3), one)
    monkeypatch.setattr(fps_samples, "cores", lambda: [0])
    assert np.array_equal(sample_all(CLOUDS, 10, 3), one)


# --- the cache --------------------------------------------------------------------------------


def numbers(folder: Path, count: int = 10, starts: int = 2, key: str = "key"):
    """Indices of `farthest_points`; and whether they were sampled anew."""
    calls = []

    def counted(*args):
        calls.append(args)
        return sample(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fps_samples, "sample_all", counted)
        return farthest_points(CLOUDS, count, starts, folder, key), bool(calls)


def cached(folder: Path) -> Path:
    (file,) = folder.glob("*.npy")
    return file


def test_what_can_be_chosen(tmp_path):
    assert farthest_points(CLOUDS, 50, 4, tmp_path) is None  # nothing to choose
    assert farthest_points(CLOUDS[:, :3], 2, 5).shape == (7, 3, 2)
    with pytest.raises(ConfigError):
        farthest_points(CLOUDS, 51)


def test_cached_as_a_map(tmp_path):
    first, sampled = numbers(tmp_path)
    assert sampled
    again, sampled = numbers(tmp_path)
    assert not sampled
    assert isinstance(again, np.memmap)
    assert np.array_equal(first, again)
    assert np.array_equal(first, sample(CLOUDS, 10, 2))


DAMAGES = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[:-50],
    "without checksum": lambda data: data[:-32],
    "one bit": lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_cache_is_redone(tmp_path, damage):
    first, _ = numbers(tmp_path)
    file = cached(tmp_path)
    sound, expected = file.read_bytes(), np.array(first)
    file.unlink()  # as writers do: the old map stays what it was
    file.write_bytes(damage(sound))
    order, sampled = numbers(tmp_path)
    assert sampled
    assert np.array_equal(order, expected)
    assert file.read_bytes() == sound


def test_interrupted_and_done_again(tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    for place, name in ((fps_samples, "sample_all"), (np, "save")):  # in the middle of writing
        with monkeypatch.context() as patch:
            patch.setattr(place, name, stop)
            with pytest.raises(KeyboardInterrupt):
                farthest_points(CLOUDS, 10, 2, tmp_path, "key")
    assert list(tmp_path.glob("*.npy")) == []
    assert np.array_equal(numbers(tmp_path)[0], sample(CLOUDS, 10, 2))
