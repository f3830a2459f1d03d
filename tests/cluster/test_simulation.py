"""The simulated course of many tasks: known answers, bounds that every course keeps, and chance."""

import heapq
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.cluster.simulation import Nodes, simulate
from qs3.errors import ConfigError

HOUR = 3600.0


def test_equal_tasks_go_in_rounds():
    course = simulate(np.full(10, HOUR), Nodes(2, 2))
    assert course.hours == pytest.approx(3.0)  # 4, 4, 2
    assert course.idle_h == pytest.approx(2.0)
    assert (course.lost_h, course.failures) == (0.0, 0)


def test_a_worker_starts_once_and_a_job_each_time():
    nodes = Nodes(1, 1, start_s=0.5 * HOUR)
    tasks = np.full(6, HOUR)
    assert simulate(tasks, nodes).hours == pytest.approx(6.5)
    assert simulate(tasks, nodes, tasks_per_job=2).hours == pytest.approx(6.5)
    assert simulate(tasks, nodes, tasks_per_job=2, start_each_job=True).hours == pytest.approx(7.5)


def test_a_slow_node_does_less():
    """Alone it takes three times as long; beside a good one it does a quarter of the tasks."""
    slow = Nodes(1, 1, slow_share=1.0, slow_times=3.0)
    assert simulate(np.full(4, HOUR), slow).hours == pytest.approx(12.0)
    half, tasks = Nodes(2, 1, slow_share=0.5, slow_times=3.0), np.full(400, HOUR)
    both = {simulate(tasks, half, seed=seed).hours for seed in range(20)}
    assert sorted(both) == pytest.approx([200.0, 300.0, 600.0])


@given(
    seconds=st.lists(st.floats(0.1, 1e4), min_size=1, max_size=40),
    nodes=st.integers(1, 5),
    workers=st.integers(1, 4),
)
def test_without_failures_it_is_list_scheduling(seconds, nodes, workers):
    """A plain twin: each task to the worker that is free first."""
    free = [0.0] * (nodes * workers)
    for task in seconds:
        heapq.heapreplace(free, free[0] + task)
    course = simulate(np.array(seconds), Nodes(nodes, workers))
    assert course.hours == pytest.approx(max(free) / HOUR)
    assert course.idle_h == pytest.approx((len(free) * max(free) - sum(seconds)) / HOUR, abs=1e-6)


@given(
    seconds=st.lists(st.floats(1.0, 2000.0), min_size=1, max_size=30),
    nodes=st.integers(1, 4),
    workers=st.integers(1, 3),
    per_job=st.integers(1, 7),
    seed=st.integers(0, 9),
    each=st.booleans(),
)
def test_all_work_is_done_whatever_fails(seconds, nodes, workers, per_job, seed, each):
    """What workers did, lost and waited is all the time there was, and none of it is negative."""
    machines = Nodes(nodes, workers, start_s=5.0, life_h=0.5, repair_min=3.0)
    course = simulate(
        np.array(seconds), machines, tasks_per_job=per_job, start_each_job=each, seed=seed
    )
    worked = course.hours * nodes * workers - course.idle_h - course.lost_h
    assert worked * HOUR >= sum(seconds) - 1e-6
    assert worked * HOUR <= sum(seconds) + 5.0 * (len(seconds) + workers * course.failures) + 1e-6
    assert min(course.idle_h, course.lost_h) >= -1e-9
    assert course.hours >= max(seconds) / HOUR
    if not course.failures:
        assert course.lost_h == 0
    again = simulate(
        np.array(seconds), machines, tasks_per_job=per_job, start_each_job=each, seed=seed
    )
    assert again == course


def test_failures_cost_what_the_formula_says():
    """Of one task of length t on a node that lives 1/f on average and is back after r:

    (e^(f t) - 1) (1/f + r) on average.
    """
    t, f, r = 1.5, 1.0, 0.25  # hours
    nodes = Nodes(1, 1, life_h=1 / f, repair_min=60 * r)
    hours = [simulate(np.array([t * HOUR]), nodes, seed=seed).hours for seed in range(4000)]
    expected = (math.exp(f * t) - 1) * (1 / f + r)
    assert abs(np.mean(hours) - expected) < 4 * np.std(hours) / math.sqrt(len(hours))


def test_what_a_job_had_done_stays_done():
    """Forty tasks of 0.1 h in one job, of which a failure takes one, not all."""
    nodes = Nodes(1, 1, life_h=1.0, repair_min=0.0)
    tasks = np.full(40, 0.1 * HOUR)
    courses = [simulate(tasks, nodes, tasks_per_job=40, seed=seed) for seed in range(300)]
    lost = sum(course.lost_h for course in courses) / sum(course.failures for course in courses)
    assert 0.04 < lost < 0.06  # half a task a failure
    assert all(course.hours == pytest.approx(4.0 + course.lost_h) for course in courses)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"number": 0}, "number must be in"),
        ({"workers": 0}, "workers must be in"),
        ({"life_h": 0}, "life_h must be in"),
        ({"slow_share": 1.5}, "slow_share must be in"),
        ({"slow_times": 0.5}, "slow_times must be in"),
        ({"start_s": -1}, "start_s must be in"),
        ({"repair_min": math.nan}, "repair_min must be in"),
    ],
)
def test_nodes_that_cannot_be_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        Nodes(**{"number": 2, "workers": 2, **change})


def test_what_cannot_end_is_refused():
    with pytest.raises(ConfigError, match="up to 6 hours, and nodes live for 1 on average"):
        simulate(np.array([1.0, 6 * HOUR]), Nodes(1, 1, life_h=1.0))
    with pytest.raises(ConfigError, match="up to 6 hours"):
        simulate(np.array([3 * HOUR]), Nodes(1, 1, life_h=1.0, slow_share=0.1))
    with pytest.raises(ConfigError, match="no task"):
        simulate(np.array([]), Nodes(1, 1))
