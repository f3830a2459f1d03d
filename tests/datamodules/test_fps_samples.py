from __future__ import annotations

import logging
from multiprocessing.context import SpawnProcess

import numpy as np

import qs3.datamodules.fps_samples
from qs3.datamodules.fps_samples import sample, sample_all, start_points
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


def test_indices_that_do_not_fit_into_sixteen_bits():
    cloud = np.random.default_rng(1).normal(size=(1, 40_000, 3)).astype(np.float32)
    order = sample(cloud, 300, 1)
    assert order.dtype == np.int32
    assert order.max() > 32_767
    assert order.min() >= 0


def test_processes_do_not_change_the_result(monkeypatch):
    monkeypatch.setattr(qs3.datamodules.fps_samples, "_CHUNK", 2)
    assert np.array_equal(sample_all(CLOUDS, 10, 3, processes=2), sample(CLOUDS, 10, 3))
    assert np.array_equal(sample_all(CLOUDS, 10, 3, processes=1), sample(CLOUDS, 10, 3))


def test_if_there_can_be_no_processes_this_one_does_it(monkeypatch, caplog):
    def full(*args, **kwargs):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(SpawnProcess, "start", full)
    with caplog.at_level(logging.WARNING):
        order = sample_all(CLOUDS, 10, 3, processes=2)
    assert np.array_equal(order, sample(CLOUDS, 10, 3))
    assert "temporarily unavailable" in caplog.text
