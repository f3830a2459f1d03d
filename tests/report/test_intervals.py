"""Intervals by hand, and how often they hold the truth."""

import numpy as np
import pytest
from scipy.stats import t as student_t

from qs3.report.intervals import _variances, difference, share


def test_a_share_by_hand():
    """One seed, two objects a block: the variance of four sums, by Student with 3 degrees."""
    right = np.array([[1, 1, 1, 0, 0, 0, 1, 1]], dtype=bool)
    labels, blocks = np.zeros(8, int), np.repeat(np.arange(4), 2)
    found = share(right, labels, blocks)
    sums = np.array([3 / 4, -1 / 4, -5 / 4, 3 / 4]) / 8  # about the mean 5/8
    half = 3.182446 * np.sqrt((sums**2).sum() * 4 / 3)
    assert (found.mean, found.sem, found.seeds, found.clusters) == (5 / 8, None, 1, 4)
    assert found.low == pytest.approx(max(0, 5 / 8 - half))
    assert found.high == pytest.approx(min(1, 5 / 8 + half))
    assert share(right, labels, np.zeros(8)).low is None


def test_a_balanced_share_by_hand():
    """Class 0 twice in each of five rooms, class 1 once in four of them, class 2 in one alone."""
    right = np.array([[1, 1, 1, 0, 1, 1, 0, 1, 1, 1, 1, 1, 0, 1, 1, 0]], dtype=bool)
    labels, blocks = np.repeat([0, 1, 2], [10, 4, 2]), [*np.repeat(range(5), 2), 0, 1, 2, 3, 4, 4]
    found = share(right, labels, np.array(blocks), balanced=True)
    first = np.array([0.4, -0.6, 0.4, -0.6, 0.4]) / 10 / 3 / np.sqrt(1 - 1 / 5)  # about 0.8
    second = np.array([0.25, 0.25, -0.75, 0.25, 0]) / 4 / 3 / np.sqrt(1 - 1 / 4)  # about 0.75
    half = 2.776445 * np.sqrt(((first + second) ** 2).sum() * 5 / 4)
    mean = (0.8 + 0.75 + 0.5) / 3
    assert (found.low, found.mean, found.high) == pytest.approx((mean - half, mean, mean + half))


def test_a_difference_by_hand():
    """Two seeds, four clouds of two meshes: A is right where B is not on (0, 0), (0, 1), (1, 0)."""
    d = np.array([[1, 1, 0, 0], [1, 0, 0, 0]], dtype=float)
    found = difference(d, np.zeros(4, int), np.array([0, 0, 1, 1]))
    # deviations from 3/8 by seed and mesh, of weight 1/4 and 1/2: (1.25, -.75), (.25, -.75) / 8
    cells = np.array([[1.25, -0.75], [0.25, -0.75]]) / 8
    left = np.array([[0.25, -0.25], [-0.25, 0.25]]) / 8  # without means of both ways
    of_meshes = max(0, 2 * np.sum(cells.sum(0) ** 2) - 4 * np.sum(left**2))
    half = student_t.ppf(0.975, 1) * np.sqrt(2 * np.sum(cells.sum(1) ** 2) + of_meshes)
    assert found.mean == 3 / 8
    ends = [max(-1, 3 / 8 - half), min(1, 3 / 8 + half)]
    np.testing.assert_allclose([found.low, found.high], ends)
    assert not found.clear


def test_balanced_takes_each_class_alike():
    labels, d = np.array([0, 0, 0, 1]), np.array([[0, 0, 0, 1.0]] * 2)
    assert difference(d, labels, np.arange(4)).mean == 1 / 4
    assert difference(d, labels, np.arange(4), balanced=True).mean == 1 / 2


def drawn(rng, seeds, meshes, scans, of_seed, of_mesh):
    """Crossed effects of seeds and meshes about a true difference of 0.1."""
    mesh = np.repeat(np.arange(meshes), scans)
    d = 0.1 + of_seed * rng.normal(size=(seeds, 1)) + of_mesh * rng.normal(size=meshes)[mesh]
    d = d + 0.4 * rng.normal(size=(seeds, len(mesh)))
    return difference(d, np.zeros(len(mesh), int), mesh)


@pytest.mark.parametrize(
    ("seeds", "of_seed", "of_mesh"), [(3, 0.0, 0.3), (3, 0.1, 0.3), (3, 0.1, 0.0), (8, 0.05, 0.3)]
)
def test_intervals_of_differences_hold_the_truth(seeds, of_seed, of_mesh):
    """95 %, less what 400 draws may miss by (standard error 1 %); never wide without reason."""
    rng = np.random.default_rng(1)
    found = [drawn(rng, seeds, 40, 3, of_seed, of_mesh) for _ in range(400)]
    assert 0.92 <= np.mean([one.low <= 0.1 <= one.high for one in found]) <= 0.995


@pytest.mark.parametrize("balanced", [False, True])
def test_intervals_of_shares_hold_the_truth_and_rooms_widen_them(balanced):
    """Rooms are easy or hard as a whole, and so are classes."""
    rng = np.random.default_rng(0)
    inside, wider, blocks = 0, 0, np.repeat(np.arange(40), 6)
    of_class = np.array([-0.1, 0.0, 0.1])
    for _ in range(300):
        labels = rng.integers(0, 3, 240)
        p = np.where(rng.random(40) < 0.5, 0.8, 0.4)[blocks] + of_class[labels]
        right = rng.random((1, 240)) < p
        found = share(right, labels, blocks, balanced=balanced)
        alone = share(right, labels, np.arange(240), balanced=balanced)
        inside += found.low <= 0.6 <= found.high
        wider += found.high - found.low > alone.high - alone.low
    assert 0.9 < inside / 300 < 0.99
    assert wider > 280


@pytest.mark.parametrize("seeds", [2, 4, 12])
def test_what_no_way_has_of_its_own_is_taken_off(seeds):
    """On average V_clusters is b's variance whatever the seeds."""
    rng, found = np.random.default_rng(7), []
    for _ in range(1000):
        a, b, left = (rng.normal(size=size) for size in ((seeds, 1), (1, 30), (seeds, 30)))
        e = 0.1 * a + 0.3 * b + 0.3 * left
        found.append(_variances(e - e.mean(), np.full(30, 1 / 30), np.arange(30)))
    of_seeds, of_clusters = np.mean(found, axis=0)
    assert of_seeds == pytest.approx(0.1**2 / seeds + 0.3**2 / (30 * seeds), rel=0.15)
    assert of_clusters == pytest.approx(0.3**2 / 30, rel=0.1)


def test_scans_of_a_mesh_are_not_counted_as_independent():
    """Ten copies of each mesh's scan say no more than one."""
    d = np.random.default_rng(2).normal(size=(3, 20)) / 3
    one = difference(d, np.zeros(20, int), np.arange(20))
    ten = difference(np.repeat(d, 10, axis=1), np.zeros(200, int), np.repeat(np.arange(20), 10))
    np.testing.assert_allclose([ten.low, ten.high], [one.low, one.high])
