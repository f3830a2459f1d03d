from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace
from fractions import Fraction

import numpy as np
import pytest

from qs3.datamodules.batches import Batches, Table
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.phases import SelfTrainingConfig
from qs3.errors import ConfigError, SelectionError
from qs3.selftraining.baselines import Random
from qs3.selftraining.cbst import Cbst
from qs3.selftraining.sd import GraphRefined
from qs3.selftraining.selectors import (
    Qbst,
    Selection,
    Spst,
    TeacherPredictions,
    check_selection,
    check_teacher,
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
        ({}, "abghj"),
        ({"order": "ascending"}, "deghj"),
        ({"mu": "one"}, "abcdeghj"),
        # L_k of all samples: 6, 3, 2; mu = 2/8, 5/8, 6/8; quotas ceil(10/8), ceil(10/8), ceil(6/8)
        ({"counts": "all"}, "abghj"),
    ],
)
def test_table_worked_by_hand(settings, expected):
    assert select(TABLE, **settings)[1] == expected


def test_figures_of_the_table():
    selection, _ = select(TABLE)
    assert selection.confident.tolist() == [5, 2, 1]
    assert selection.kept.tolist() == [2, 2, 1]
    assert selection.mu.tolist() == [3 / 8, 6 / 8, 7 / 8]


def test_more_predicted_than_confident_is_clamped():
    table = [("a", 0, 0.9), ("b", 1, 0.9), *((f"z{i}", 0, 0.1) for i in range(9))]
    selection, kept = select(table, classes=2, counts="all")
    assert selection.mu.tolist() == [0.0, 0.5]
    assert kept == "b"


def test_the_paper_s_example_of_a_perfect_teacher():
    """ScanNet10's 80 % part, all confident: mu = .58 for chair and 3740 in all."""
    sizes = [80, 270, 388, 517, 2070, 130, 164, 71, 391, 807]
    predicted = np.repeat(np.arange(10), sizes)
    ids = [f"{i:05d}" for i in range(len(predicted))]
    selection = Qbst().select(TeacherPredictions(ids, np.full(len(ids), 0.9), predicted, 10), 0.8)
    assert selection.kept[4] == 1194
    assert abs(int(selection.kept.sum()) - 3740) <= 10
    exact = [math.ceil((1 - Fraction(n, 4888)) * n) for n in sizes]
    assert selection.kept.tolist() == exact


def test_one_class_only_is_an_error_that_says_so():
    selection, kept = select([("a", 1, 0.9), ("b", 1, 0.95)])
    assert kept == ""
    with pytest.raises(SelectionError, match=r"round 3 with theta=0\.8.*y 0/2.*of one class"):
        check_selection(selection, ("x", "y", "z"), 3, "warn")


def test_nothing_confident_is_an_error_with_counts():
    selection, _ = select(TABLE, theta=0.995)
    with pytest.raises(SelectionError, match=r"only 0 .*theta=0\.995.*x 0/0.*lower selftraining"):
        check_selection(selection, ("x", "y", "z"), 0, "warn")


@pytest.mark.parametrize(
    ("confident", "advice"),
    [([1, 0, 0], "of one class"), ([0, 8, 0], "of one class"), ([1, 1, 0], "lower selftraining")],
)
def test_two_pseudo_labels_are_the_least(confident, advice):
    def chosen(kept):
        return Selection(np.ones(9, bool), 0.8, np.zeros(3), np.array(confident), np.array(kept))

    assert check_selection(chosen([1, 1, 0]), ("x", "y", "z"), 0, "warn") == ["z"]
    with pytest.raises(SelectionError, match=f"only 1 .*{advice}"):
        check_selection(chosen([1, 0, 0]), ("x", "y", "z"), 0, "warn")
    with pytest.raises(ValueError, match="zip"):
        check_selection(chosen([1, 1, 0]), ("x", "y"), 0, "warn")
    one_short = replace(chosen([1, 1, 0]), confident=np.array([1, 1]))
    with pytest.raises(ValueError, match="zip"):
        check_selection(one_short, ("x", "y", "z"), 0, "warn")


@pytest.mark.parametrize("processes", [2, 3, 8])
def test_each_process_needs_two(processes):
    """One more than processes is enough: what is uneven is drawn twice."""
    few, enough = (
        Selection(np.ones(n, bool), 0.8, np.ones(2), np.array([n, 0]), np.array([n, 0]))
        for n in (processes, processes + 1)
    )
    assert check_selection(enough, ("x", "y"), 0, "warn", processes=processes) == ["y"]
    assert check_selection(few, ("x", "y"), 0, "warn") == ["y"]
    said = f"only {processes} .*each of {processes} processes needs two; .*fewer trainer.devices$"
    with pytest.raises(SelectionError, match=said):
        check_selection(few, ("x", "y"), 0, "warn", processes=processes)
    for n, each in ((processes, 1), (processes + 1, 2)):
        table = Table(Clouds.of(np.zeros((n, 4, 3), np.float32)), {})
        shares = [Batches({"target": table}, 8, seed=0, epoch=0, rank=r, world=processes).sizes
                  for r in range(processes)]  # fmt: skip
        assert shares == [[each]] * processes


def test_advice_is_about_the_selector_in_use():
    """One sure sample of one class: QBST's mu is 0, SPST has none, CBST has no use for theta."""
    probabilities = np.array([[0.9, 0.1], [0.6, 0.4], [0.6, 0.4]])
    teacher = TeacherPredictions.of(probabilities, ["a", "b", "c"])
    for selector, theta, advice in (
        (Qbst(), 0.8, "so its mu is 0; .*mu=one$"),
        (Qbst(mu="one"), 0.8, r"b 0/0; lower selftraining.theta, or train the teacher longer"),
        (Spst(), 0.8, r"b 0/0; lower selftraining.theta, or train the teacher longer"),
        (Cbst(), 0.0, r"b 0/0; raise selftraining.selector.portion and .most, or train"),
        (Random(of=Cbst()), 0.0, r"; raise selftraining\.selector\.of\.portion and .most, or"),
        (Cbst(), 0.95, r"; lower selftraining.theta, or raise selftraining.selector.portion and"),
        (Random(of=Qbst()), 0.8, r"so its mu is 0; .*set selftraining\.selector\.of\.mu=one$"),
        (Random(of=Random(of=Qbst())), 0.8, r"set selftraining\.selector\.of\.of\.mu=one$"),
        (GraphRefined(), 0.8, r"b 0/0; lower selftraining.theta, or train the teacher longer"),
    ):
        scheme = SelfTrainingConfig(selector, rounds=1, theta=theta)
        more, other = scheme.more_labels, scheme.instead_of_mu
        selection = selector.select(teacher, theta)
        with pytest.raises(SelectionError, match=advice):
            check_selection(selection, ("a", "b"), 0, "warn", more, instead_of_mu=other)
    more = SelfTrainingConfig(Qbst(), rounds=1, share=0.2).more_labels
    selection = Qbst().select(teacher, 0.8)
    with pytest.raises(SelectionError, match=r"its mu is 0; raise selftraining.share, or set .*mu"):
        check_selection(selection, ("a", "b"), 0, "warn", more, longer=None)
    unsure = TeacherPredictions.of(np.vstack([probabilities, [0.5, 0.5]]), ["a", "b", "c", "d"])
    selection = Qbst(mu="one").select(unsure, 0.5)
    assert check_selection(selection, ("a", "b"), 0, "warn", more) == ["b"]
    with pytest.raises(
        SelectionError, match=r"no pseudo-label for b .*; raise selftraining.share,"
    ):
        check_selection(selection, ("a", "b"), 0, "error", more)


def test_no_lower_threshold_is_advised_where_all_are_above_it():
    one = TeacherPredictions.of(np.array([[0.9, 0.1], [0.8, 0.2], [0.7, 0.3]]), ["a", "b", "c"])
    asked = ("a", "b"), 0, "error"
    longer = r"train the teacher longer \(protocol\.epochs\), or "
    for scheme, theta in (
        (SelfTrainingConfig(Spst(), rounds=1, theta=0.5), 0.5),
        (SelfTrainingConfig(Spst(), rounds=1, share=0.9), 0.5),
        (SelfTrainingConfig(GraphRefined(), rounds=1, theta=0), 0.0),
        (SelfTrainingConfig(Cbst(portion=0.5), rounds=1, theta=0), 0.0),
        (SelfTrainingConfig(Cbst(portion=0.5, most=1.0), rounds=1, theta=0.5), 0.5),
    ):
        selection = scheme.selector.select(one, theta)
        for by, ways in (("protocol.epochs", longer), (None, "")):
            said = rf"for b in .*b 0/0; the teacher takes no cloud for one; {ways}accept it with"
            if int(selection.kept.sum()) < 2:
                said = "only 1 pseudo-label"
            with pytest.raises(SelectionError, match=said):
                check_selection(selection, *asked, scheme.more_labels, by)
    selection = Qbst().select(one, 0.5)
    with pytest.raises(SelectionError, match=rf"its mu is 0; {longer}set selftraining\S*mu=one$"):
        check_selection(selection, *asked)
    # Of CBST the class has clouds, and its portion is less than one: more of it selects one.
    two = TeacherPredictions.of(np.array([[0.9, 0.1]] * 4 + [[0.4, 0.6]]), list("abcde"))
    selection = Cbst(portion=0.5).select(two, 0.0)
    with pytest.raises(SelectionError, match=r"b 0/1; raise selftraining\.selector\.portion and"):
        check_selection(selection, *asked, Cbst.more_labels.split(", or "))


@pytest.mark.parametrize(
    ("round_", "trainable", "message"),
    [
        (
            0,
            True,
            r"the warm-up's net has diverged: .* of 1 of 2 target .*lower protocol\.optimizer",
        ),
        (0, False, r"the net of weights= has diverged: .*; choose another one$"),
        (2, False, r"round 1's student has diverged: .*round 2 has no .*lower protocol\.optimizer"),
    ],
)
def test_a_teacher_that_diverged_is_said_to_have(round_, trainable, message):
    sure = np.array([[0.9, 0.1], [0.2, 0.8]])
    check_teacher(TeacherPredictions.of(sure, ["a", "b"]), round_, trainable)
    sure[1] = np.nan
    with pytest.raises(SelectionError, match=message):
        check_teacher(TeacherPredictions.of(sure, ["a", "b"]), round_, trainable)


def test_predictions_selections_and_rules_cannot_be_changed():
    selection, _ = select(TABLE)
    teacher = TeacherPredictions(["a"], np.array([0.9]), np.array([0]), 1)
    for made, key in ((selection, "theta"), (teacher, "classes"), (Qbst(), "mu"), (Spst(), "pace")):
        with pytest.raises(FrozenInstanceError):
            setattr(made, key, 1)
    assert len({selection, teacher}) == 2  # told apart as objects: arrays have no truth


def test_missing_class():
    selection, _ = select([row for row in TABLE if row[1] != 2])
    assert check_selection(selection, ("x", "y", "z"), 0, "warn") == ["z"]
    with pytest.raises(SelectionError, match="no pseudo-label for z"):
        check_selection(selection, ("x", "y", "z"), 0, "error")


@pytest.mark.parametrize("settings", [{"mu": "two"}, {"order": "up"}, {"counts": "some"}])
def test_wrong_setting_names_the_key(settings):
    (key,) = settings
    with pytest.raises(ConfigError, match=f"selftraining.selector.{key}"):
        Qbst(**settings)


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


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (np.array([True, False]), "ndarray"),
        (np.array([0]), "int64 [1]"),
        (np.array([True]), "bool [1]"),
        ([True, False], "list"),
        (None, "NoneType"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_what_a_selector_of_one_s_own_returns_is_looked_at(returned, said):
    """Places of samples were taken for a mask, and other samples than these trained on."""
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6]]), ["a", "b"])
    good = Spst().select(teacher, 0.5)

    class Own:
        def select(self, teacher, theta, round_=0):
            if said in ("ndarray", "NoneType"):
                return returned
            return replace(good, selected=returned)

    with pytest.raises(ConfigError, match=r"^Own\.select must return a Selection") as told:
        chosen_by(Own(), teacher, 0.5, 0)
    assert f"each of 2 samples; it is {said}" in str(told.value).replace("of type ", "")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"labels": np.array([0, 2])}, "`labels` must lie in 0 to 1"),
        ({"labels": np.array([0.0, 1.0])}, "`labels` must be an array [2] of whole numbers"),
        ({"soft": np.array([0.5, 0.5])}, "`soft` must be an array [2, 2] of numbers, it is"),
        ({"confident": np.array([1.0, 1.0])}, "`confident` must be an array [2] of whole numbers"),
        ({"mu": None}, "`mu` must be an array [2] of numbers, it is object []"),
    ],
)
def test_figures_of_a_selector_of_one_s_own_are_looked_at(changes, said):
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6]]), ["a", "b"])
    good = Spst().select(teacher, 0.5)

    class Own:
        def select(self, teacher, theta, round_=0):
            return replace(good, **changes)

    with pytest.raises(ConfigError) as told:
        chosen_by(Own(), teacher, 0.5, 0)
    assert str(told.value).startswith(f"Own.select: {said}")


def test_what_is_kept_is_counted_by_the_mask():
    """A selector that counts before its last rule made metrics.json differ from what is trained."""
    teacher = TeacherPredictions.of(np.array([[0.9, 0.1], [0.4, 0.6], [0.3, 0.7]]), "abc")

    class Own:
        def select(self, teacher, theta, round_=0):
            mask = np.array([False, True, True])
            return replace(Spst().select(teacher, theta), selected=mask)

    assert chosen_by(Own(), teacher, 0.5, 0).kept.tolist() == [0, 2]


@pytest.mark.parametrize(
    ("selector", "setting", "instead"),
    [
        (Qbst, {"mu": "one", "order": "ascending"}, r"set \S+mu=balanced, or leave it at desc"),
        (Qbst, {"mu": "one", "counts": "all"}, r"set \S+mu=balanced, or leave it at confident"),
        (Cbst, {"labels": "hard", "alpha": 0.5}, r"set \S+labels=lrent, or leave it at 0\.25"),
        (GraphRefined, {"graph": False, "correlation": 0.5}, r"set \S+graph=true, or .* 0\.95"),
        (GraphRefined, {"graph": False, "neighbours": 3}, r"set \S+graph=true, or .* 10"),
        (GraphRefined, {"graph": False, "steps": 3}, r"set \S+graph=true, or .* 1000"),
    ],
)
def test_a_setting_that_nothing_reads_is_refused(selector, setting, instead):
    """Its run would be another's copy under a name of its own."""
    *_, key = setting
    with pytest.raises(ConfigError, match=rf"selector\.{key}=\S+ would have no effect; {instead}"):
        selector(**setting)
    selector(**{key: setting[key]}, **({"labels": "lrent"} if selector is Cbst else {}))
