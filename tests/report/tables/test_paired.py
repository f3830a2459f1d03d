from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student_t

from qs3.errors import DataError
from qs3.report.clustered import variances
from qs3.report.tables.paired import compare, compare_on_average, interval
from qs3.runs.predictions import Predictions


def predictions(labels, predicted, meshes, ids=None) -> Predictions:
    n = len(labels)
    return Predictions(
        ("a", "b"),
        tuple(ids or map(str, range(n))),
        tuple(meshes),
        np.array(labels),
        np.eye(2)[predicted],
    )


def two_rows():
    labels, meshes = [0, 0, 0, 0], ["m", "m", "n", "n"]
    b = [predictions(labels, [1, 1, 0, 0], meshes)] * 2
    a = [predictions(labels, [0, 0, 0, 0], meshes), predictions(labels, [0, 1, 0, 0], meshes)]
    return a, b


def test_by_hand():
    """Two seeds, four clouds of two meshes: A is right where B is not on (0, 0), (0, 1), (1, 0)."""
    found = compare(*two_rows())
    assert found.mean == 3 / 8
    assert (found.seeds, found.meshes) == (2, 2)
    # deviations from 3/8 by seed and mesh, of weight 1/4 and 1/2: (1.25, -.75), (.25, -.75) / 8
    cells = np.array([[1.25, -0.75], [0.25, -0.75]]) / 8
    of_seeds = 2 * np.sum(cells.sum(1) ** 2)
    of_meshes = 2 * np.sum(cells.sum(0) ** 2)
    left = np.array([[0.25, -0.25], [-0.25, 0.25]]) / 8  # without means of both ways
    of_meshes = max(0, of_meshes - 4 * np.sum(left**2))
    half = student_t.ppf(0.975, 1) * np.sqrt(of_seeds + of_meshes)
    np.testing.assert_allclose([found.low, found.high], [3 / 8 - half, 3 / 8 + half])
    assert not found.clear


def test_balanced_weighs_classes_alike():
    labels = [0, 0, 0, 1]
    meshes = list("mnop")
    a = [predictions(labels, [0, 0, 0, 1], meshes)] * 2
    b = [predictions(labels, [0, 0, 0, 0], meshes)] * 2
    assert compare(a, b).mean == 1 / 4
    assert compare(a, b, balanced=True).mean == 1 / 2


def test_several_differences_on_average():
    """Those of one row and their opposite cancel; with an equal pair a difference halves."""
    a, b = two_rows()
    one, half = compare(a, b), compare_on_average([(a, b), (b, b)])
    np.testing.assert_allclose(
        [half.mean, half.low, half.high], [one.mean / 2, one.low / 2, one.high / 2]
    )
    both = compare_on_average([(a, b), (b, a)])
    assert (both.mean, both.low, both.high) == (0, 0, 0)
    with pytest.raises(DataError, match="got 1 and 2"):
        compare_on_average([(a, b), (a[:1], b[:1])])


def test_equal_rows_do_not_differ():
    rng = np.random.default_rng(0)
    runs = [predictions([0, 1] * 10, rng.integers(0, 2, 20), map(str, range(20))) for _ in "abc"]
    found = compare(runs, runs)
    assert (found.mean, found.low, found.high, found.seeds_needed) == (0, 0, 0, None)


def simulated(rng, seeds, meshes, scans, of_seed, of_mesh):
    """Crossed effects of seeds and meshes about a true difference of 0.1."""
    mesh = np.repeat(np.arange(meshes), scans)
    d = 0.1 + of_seed * rng.normal(size=(seeds, 1)) + of_mesh * rng.normal(size=meshes)[mesh]
    d = d + 0.4 * rng.normal(size=(seeds, len(mesh)))
    return interval(d, np.full(len(mesh), 1 / len(mesh)), mesh)


@pytest.mark.parametrize(
    ("seeds", "of_seed", "of_mesh"), [(3, 0.0, 0.3), (3, 0.1, 0.3), (3, 0.1, 0.0), (8, 0.05, 0.3)]
)
def test_intervals_cover_as_often_as_they_say(seeds, of_seed, of_mesh):
    """95 %, less what 500 draws may miss by (standard error 1 %); never wide without reason."""
    rng = np.random.default_rng(1)
    found = [simulated(rng, seeds, 40, 3, of_seed, of_mesh) for _ in range(500)]
    covered = np.mean([one.low <= 0.1 <= one.high for one in found])
    assert 0.92 <= covered <= 0.995


@pytest.mark.parametrize("alike", [1.0, 0.95, 0.5])
@pytest.mark.parametrize("seeds", [2, 3, 5])
def test_intervals_cover_where_seeds_agree(seeds, alike):
    """A share `alike` of the meshes has one answer in all seeds, as right answers mostly do."""
    rng = np.random.default_rng(5)
    chance = [0.1, 0.75, 0.15]
    inside = []
    for _ in range(400):
        one = rng.choice([-1.0, 0.0, 1.0], 100, p=chance)
        other = rng.choice([-1.0, 0.0, 1.0], (seeds, 100), p=chance)
        d = np.where(rng.random(100) < alike, one, other)
        found = interval(d, np.full(100, 1 / 100), np.arange(100))
        inside.append(found.low <= 0.05 <= found.high)
    assert np.mean(inside) >= 0.92


@pytest.mark.parametrize("seeds", [2, 3, 10])
def test_copies_of_a_seed_say_nothing_new(seeds):
    rng = np.random.default_rng(6)
    d, mesh = rng.normal(size=(1, 60)), np.repeat(np.arange(20), 3)
    weight = np.full(60, 1 / 60)
    none, once = variances(d - d.mean(), weight, mesh)
    np.testing.assert_allclose(
        variances(np.repeat(d - d.mean(), seeds, axis=0), weight, mesh), (none, once), atol=1e-18
    )


@pytest.mark.parametrize("seeds", [2, 4, 12])
def test_what_no_way_has_of_its_own_is_taken_off(seeds):
    """On average V_clusters is b's variance whatever the seeds, which `seeds_needed` relies on."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(1000):
        a, b, left = (rng.normal(size=size) for size in ((seeds, 1), (1, 30), (seeds, 30)))
        e = 0.1 * a + 0.3 * b + 0.3 * left
        found.append(variances(e - e.mean(), np.full(30, 1 / 30), np.arange(30)))
    of_seeds, of_clusters = np.mean(found, axis=0)
    assert of_seeds == pytest.approx(0.1**2 / seeds + 0.3**2 / (30 * seeds), rel=0.15)
    assert of_clusters == pytest.approx(0.3**2 / 30, rel=0.1)


def test_scans_of_a_mesh_are_not_counted_as_independent():
    """Ten copies of each mesh's scan say no more than one."""
    rng = np.random.default_rng(2)
    d = rng.normal(size=(3, 20))
    one = interval(d, np.full(20, 1 / 20), np.arange(20))
    ten = interval(np.repeat(d, 10, axis=1), np.full(200, 1 / 200), np.repeat(np.arange(20), 10))
    np.testing.assert_allclose([ten.low, ten.high], [one.low, one.high])


def test_seeds_needed_are_enough_and_no_more_than_enough():
    rng = np.random.default_rng(3)
    found = simulated(rng, 3, 200, 1, 0.15, 0.1)
    assert not found.clear
    assert found.seeds_needed is not None
    assert found.seeds_needed > 3
    # more seeds of the same kind: with about that number the difference becomes clear
    many = [simulated(rng, 4 * found.seeds_needed, 200, 1, 0.15, 0.1).clear for _ in range(20)]
    assert np.mean(many) > 0.8


def test_too_few_meshes_cannot_be_mended_by_seeds():
    rng = np.random.default_rng(4)
    found = simulated(rng, 3, 6, 1, 0.0, 2.0)
    assert found.seeds_needed is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ids": list("zyxw")}, "different clouds"),
        ({"labels": [0, 1, 0, 1]}, "different clouds"),
        ({"labels": [-1, -1, -1, -1]}, "different clouds"),
    ],
)
def test_what_cannot_be_paired_is_refused(change, message):
    fine = {"labels": [0, 0, 1, 1], "predicted": [0, 0, 0, 0], "meshes": list("mnop")}
    a = predictions(**fine)
    with pytest.raises(DataError, match=message):
        compare([a, a], [a, predictions(**{**fine, **change})])


def test_too_little_to_compare():
    one = predictions([0, 1], [0, 0], "mn")
    with pytest.raises(DataError, match="two seeds"):
        compare([one], [one])
    unlabelled = predictions([-1, -1], [0, 0], "mn")
    with pytest.raises(DataError, match="no labels"):
        compare([unlabelled] * 2, [unlabelled] * 2)
    same = predictions([0, 1], [0, 0], "mm")
    with pytest.raises(DataError, match="two meshes"):
        compare([same] * 2, [same] * 2)
