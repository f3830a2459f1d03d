from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace
from fractions import Fraction

import numpy as np
import pytest

from qs3.datamodules.batches import Batches
from qs3.datamodules.clouds import Clouds
from qs3.errors import ConfigError, SelectionError
from qs3.selftraining.selectors import (
    Qbst,
    Selection,
    Spst,
    TeacherPredictions,
    check_selection,
    chosen_by,
    doubts,
    most_confident,
    ranked,
)

# Worked by hand for theta = 0.8. Confident: class 0: a b c d e (5), class 1: g h (2),
# class 2: j (1); n = 8, mu = 3/8, 6/8, 7/8; quotas ceil(15/8) = 2, ceil(12/8) = 2, ceil(7/8) = 1.
TABLE = [
    ("a", 0, 0.95),
    ("b", 0, 0.99),
    ("c", 0, 0.95),  # ties with a, which a lot puts first
    ("d", 0, 0.85),
    ("e", 0, 0.81),
    ("f", 0, 0.80),  # not above the threshold
    ("g", 1, 0.90),
    ("h", 1, 0.82),
    ("i", 1, 0.50),
    ("j", 2, 0.83),
    ("k", 2, 0.10),
]


def select(table, theta=0.8, classes=3, **settings):
    ids, predicted, confidence = zip(*table, strict=True)
    teacher = TeacherPredictions(ids, np.array(confidence), np.array(predicted), classes)
    selection = Qbst(**settings).select(teacher, theta)
    return selection, "".join(sorted(np.array(ids)[selection.selected]))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"counts": "confident"}, "abghj"),
        ({"counts": "confident", "order": "ascending"}, "deghj"),
        ({"mu": "one"}, "abcdeghj"),
        # L_k of all samples: 6, 3, 2; mu = 2/8, 5/8, 6/8; quotas ceil(10/8), ceil(10/8), ceil(6/8)
        ({}, "abghj"),
        ({"floor": 0.5}, "abcghj"),
    ],
)
def test_table_worked_by_hand(settings, expected):
    assert select(TABLE, **settings)[1] == expected


def test_figures_of_the_table():
    selection, _ = select(TABLE, counts="confident")
    assert selection.confident.tolist() == [5, 2, 1]
    assert selection.kept.tolist() == [2, 2, 1]
    assert selection.mu.tolist() == [3 / 8, 6 / 8, 7 / 8]


def test_more_predicted_than_confident_is_clamped():
    table = [("a", 0, 0.9), ("b", 1, 0.9), *((f"z{i}", 0, 0.1) for i in range(9))]
    selection, kept = select(table, classes=2)
    assert selection.mu.tolist() == [0.0, 0.5]
    assert kept == "b"


def test_the_paper_s_example_of_a_perfect_teacher():
    """ScanNet10's 80 % part, all confident: mu = .58 for chair and 3740 in all."""
    sizes = [80, 270, 388, 517, 2070, 130, 164, 71, 391, 807]
    predicted = np.repeat(np.arange(10), sizes)
    ids = [f"{i:05d}" for i in range(len(predicted))]
    selection = Qbst(counts="confident").select(
        TeacherPredictions(ids, np.full(len(ids), 0.9), predicted, 10), 0.8
    )
    assert selection.kept[4] == 1194
    assert abs(int(selection.kept.sum()) - 3740) <= 10
    exact = [math.ceil((1 - Fraction(n, 4888)) * n) for n in sizes]
    assert selection.kept.tolist() == exact


def test_the_surest_worked_by_hand():
    confidence = np.array([0.9, 0.8, 0.7, 0.6, 0.9, 0.9, 0.6])  # a b c d are 0, e f g are 1
    labels = np.array([0, 0, 0, 0, 1, 1, 1])

    def kept(share, ids="abcdefg", **more):
        chosen = most_confident(confidence, labels, share, list(ids), **more)
        return "".join(np.array(list("abcdefg"))[chosen])

    for share, expected in ((0.0, ""), (0.5, "abef"), (0.74, "abcef"), (1.0, "abcdefg")):
        assert kept(share) == expected
    assert [kept(0.01), kept(0.01, least=1), kept(0.5, least=3)] == ["", "ae", "abcefg"]
    assert [kept(0.3), kept(0.3, ids="abcdfeg")] == ["ae", "af"]  # ties
    assert kept(0.3, doubt=np.array([0, 0, 0, 0, 2e-20, 1e-20, 0])) == "af"
    three = most_confident(confidence, np.array([0, 0, 1, 1, 2, 2, 2]), 0.2, list("abcdefg"))
    assert np.flatnonzero(three).tolist() == [4]  # 0.6 of three; 0.4 of two are none


def test_ties_go_by_doubt_then_by_lot():
    confidence, doubt = np.array([1.0, 1.0, 0.9, 1.0]), np.array([2e-20, 1e-30, 0.1, 2e-20])
    ids = ["a", "b", "c", "z"]
    assert ranked(confidence, ids, doubt).tolist() == [1, 0, 3, 2]
    assert ranked(confidence, ids, doubt, ascending=True).tolist() == [2, 0, 3, 1]
    many = [f"{name}/train/{i}" for name in ("bed", "sofa") for i in range(100)]
    first = ranked(np.ones(200), many)[:100]
    assert 35 <= (first < 100).sum() <= 65
    half = doubts(np.array([[1.0, 3e-20, 1e-20], [0.25, 0.25, 0.5]]), np.array([0, 1]))
    assert half == pytest.approx([4e-20, 0.75], rel=1e-12, abs=0)


def test_what_is_kept_is_counted_by_the_mask():
    """A selector that counts before its last rule made metrics.json differ from what is trained."""
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6], [0.3, 0.7]]), "abc")

    class Own:
        def select(self, teacher, theta, round_=0):
            mask = np.array([False, True, True])
            return replace(Spst().select(teacher, theta), selected=mask)

    assert chosen_by(Own(), teacher, 0.5, 0).kept.tolist() == [0, 2]


def test_predictions_and_selections_are_told_apart_by_identity_and_stay_as_they_are():
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6]]), "ab")
    selection = Spst().select(teacher, 0.5)
    assert len({teacher, replace(teacher), selection, replace(selection)}) == 4
    for one, name in ((teacher, "classes"), (selection, "theta")):
        with pytest.raises(FrozenInstanceError):
            setattr(one, name, 0)


def of_counts(kept, n: int = 9) -> Selection:
    return Selection(np.ones(n, bool), 0.8, np.zeros(len(kept)), np.array(kept), np.array(kept))


def test_two_pseudo_labels_are_the_least():
    assert check_selection(of_counts([1, 1, 0]), ("x", "y", "z"), 0) == ["z"]
    for few in ([1, 0, 0], [0, 0, 0]):
        with pytest.raises(SelectionError, match=f"^round 3: {sum(few)} "):
            check_selection(of_counts(few), ("x", "y", "z"), 3)
    with pytest.raises(ValueError, match="zip"):
        check_selection(of_counts([1, 1, 0]), ("x", "y"), 0)


def test_a_missing_class_is_named():
    selection, _ = select([row for row in TABLE if row[1] != 2])
    assert check_selection(selection, ("x", "y", "z"), 0) == ["z"]


@pytest.mark.parametrize("processes", [2, 3, 8])
def test_each_process_needs_two(processes):
    """One more than processes is enough: what is uneven is drawn twice."""
    few, enough = of_counts([processes, 0]), of_counts([processes + 1, 0])
    assert check_selection(enough, ("x", "y"), 0, processes=processes) == ["y"]
    assert check_selection(few, ("x", "y"), 0) == ["y"]
    with pytest.raises(SelectionError):
        check_selection(few, ("x", "y"), 0, processes=processes)
    for n, each in ((processes, 1), (processes + 1, 2)):
        clouds = Clouds.of(np.zeros((n, 4, 3), np.float32))
        shares = [
            Batches({"target": clouds}, 8, seed=0, epoch=0, rank=rank, world=processes).sizes
            for rank in range(processes)
        ]
        assert shares == [[each]] * processes


@pytest.mark.parametrize(
    "returned",
    [np.array([0]), np.array([True]), np.array([True] * 3), np.array([0, 1]), np.array([0.0, 1.0])],
    ids=["index", "short", "long", "int", "float"],
)
def test_positions_of_a_user_s_selector_are_not_taken_for_a_mask(returned):
    """Other samples than these would be trained on."""
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6]]), ["a", "b"])
    good = Spst().select(teacher, 0.5)

    class Own:
        def select(self, teacher, theta, round_=0):
            return replace(good, selected=returned)

    with pytest.raises(ConfigError, match=r"Own\.select"):
        chosen_by(Own(), teacher, 0.5, 0)


@pytest.mark.parametrize("wrong", [{"mu": "two"}, {"order": "up"}, {"counts": "some"}])
def test_wrong_settings_are_refused(wrong):
    assert Spst() == Spst()
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Qbst(**wrong)
