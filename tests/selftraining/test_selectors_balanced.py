"""SPST, CBST, CRST and the random control: tables worked by hand, and what always holds."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.selftraining.cbst import Cbst, class_thresholds
from qs3.selftraining.selectors import Qbst, Random, Spst, TeacherPredictions


def select(selector, probabilities, theta=0.0, ids=None, round_=0):
    """A selection, and the ids kept with their pseudo-labels, e.g. "a0 b1"."""
    p = np.asarray(probabilities, dtype=float)
    ids = ids if ids is not None else [chr(ord("a") + i) for i in range(len(p))]
    selection = selector.select(TeacherPredictions.of(p, ids), theta, round_)
    labels = p.argmax(axis=1) if selection.labels is None else selection.labels
    kept = sorted(f"{i}{k}" for i, k, s in zip(ids, labels, selection.selected, strict=True) if s)
    return selection, " ".join(kept)


# Portion 0.5. Predicted 0: a b c d (.9 .8 .7 .6): rank floor(2) = 2, theta_0 = .8.
# Predicted 1: e f g (.6 .5 .4): rank floor(1.5) = 1, theta_1 = .6.
# Predicted 2: h: rank 0, theta_2 = 1.
TABLE = [
    [0.90, 0.05, 0.05],  # a: .9/.8 > 1
    [0.80, 0.15, 0.05],  # b: .8/.8 = 1: kept
    [0.70, 0.20, 0.10],  # c: .875
    [0.60, 0.38, 0.02],  # d: .75
    [0.30, 0.60, 0.10],  # e: .6/.6 = 1: kept
    [0.45, 0.50, 0.05],  # f: .5625, .833
    [0.35, 0.40, 0.25],  # g
    [0.10, 0.10, 0.80],  # h: .8/1
]


def test_cbst_worked_by_hand() -> None:
    selection, kept = select(Cbst(portion=0.5), TABLE)
    assert selection.thresholds.tolist() == [0.8, 0.6, 1.0]
    assert kept == "a0 b0 e1"
    assert selection.kept.tolist() == [2, 1, 0]
    assert selection.confident.tolist() == [4, 3, 1]
    assert selection.mu.tolist() == [0.5] * 3


def test_cbst_overrules_the_most_probable_class() -> None:
    # predicted 0: a b c: rank 1, theta_0 = .99; predicted 1: d e: rank 1, theta_1 = .42
    table = [[0.99, 0.01, 0.0], [0.98, 0.02, 0.0], [0.55, 0.45, 0.0],
             [0.30, 0.42, 0.28], [0.30, 0.41, 0.29]]  # fmt: skip
    selection, kept = select(Cbst(portion=0.5), table)
    assert selection.thresholds.tolist() == [0.99, 0.42, 1.0]
    assert selection.labels.tolist() == [0, 0, 1, 1, 1]  # c: .55/.99 < .45/.42
    assert kept == "a0 c1 d1"
    assert selection.kept.tolist() == [1, 2, 0]


def test_lrent_worked_by_hand() -> None:
    # portion .5: theta = (.9, .6). q = p / theta; kept if q_0^4 + q_1^4 > 1; soft labels q^4.
    table = [[0.9, 0.1], [0.8, 0.2], [0.4, 0.6], [0.45, 0.55]]
    selection, kept = select(Cbst(portion=0.5, labels="lrent"), table)
    assert selection.thresholds.tolist() == [0.9, 0.6]
    q = np.array(table) / [0.9, 0.6]
    powers = q**4
    assert kept == "a0 c1"  # b: .6243 + .0123; d: .0625 + .706
    assert (powers.sum(axis=1) > 1).tolist() == [True, False, True, False]
    np.testing.assert_allclose(selection.soft, powers / powers.sum(axis=1, keepdims=True))


def test_lrent_at_a_tie_of_its_condition() -> None:
    # No rank for anybody, so theta = (1, 1), and with alpha = 1 both sides are log 1: not kept.
    table = [[0.5, 0.5], [0.5, 0.5]]
    selection, kept = select(Cbst(portion=0.4, labels="lrent", alpha=1.0), table)
    assert selection.thresholds.tolist() == [1.0, 1.0]
    assert selection.soft.tolist() == table
    assert kept == ""


@pytest.mark.parametrize("gap", [4, 8, 10, 12, 20, 200])
def test_lrent_keeps_what_exact_sums_keep(gap: int) -> None:
    """Five clouds a class, so that one of each sets its threshold; of teachers ever surer."""
    rng = np.random.default_rng(gap)
    logits = rng.normal(size=(50, 10))
    logits[np.arange(50), np.repeat(np.arange(10), 5)] += gap
    p = np.exp(logits - logits.max(axis=1, keepdims=True))
    p /= p.sum(axis=1, keepdims=True)
    ids = [f"{i:02d}" for i in range(50)]
    selection, _ = select(Cbst(labels="lrent"), p, ids=ids)
    theta = [Fraction(t) for t in selection.thresholds.tolist()]
    exact = [
        sum((Fraction(x) / t) ** 4 for x, t in zip(row, theta, strict=True)) > 1
        for row in p.tolist()
    ]
    assert selection.selected.tolist() == exact
    assert (selection.kept > 0).all()


def test_lrent_of_a_teacher_whose_doubt_is_below_float64() -> None:
    """No softmax says 0, but one that was rounded; CBST keeps those, too."""
    _, kept = select(Cbst(portion=0.5, labels="lrent"), [[1, 0], [1, 0], [0, 1], [0.1, 0.9]])
    assert kept == "a0 b0 c1"


def test_the_round_is_the_first_unless_one_is_named() -> None:
    teacher = TeacherPredictions.of(np.array(TABLE * 3), [f"{i:02d}" for i in range(24)])
    for selector in (Cbst(step=0.3), Random(Qbst())):
        assert selector.select(teacher, 0.5).mu.tolist() == (
            selector.select(teacher, 0.5, 0).mu.tolist()
        )
        assert selector.select(teacher, 0.5).selected.tolist() == (
            selector.select(teacher, 0.5, 0).selected.tolist()
        )
    assert Cbst(step=0.3).select(teacher, 0.0).selected.sum() < (
        Cbst(step=0.3).select(teacher, 0.0, 1).selected.sum()
    )


probabilities = st.lists(
    st.lists(st.integers(1, 12), min_size=4, max_size=4), min_size=1, max_size=40
).map(lambda rows: np.array([[x / sum(row) for x in row] for row in rows]))


thetas = st.sampled_from([0.3, 0.5, 0.8])


@given(probabilities, thetas)
def test_spst_keeps_every_confident_sample(p, theta) -> None:
    ids = [f"{i:02d}" for i in range(len(p))]
    selection, kept = select(Spst(), p, theta, ids)
    assert selection.selected.tolist() == (p.max(axis=1) > theta).tolist()
    assert kept == select(Qbst(mu="one"), p, theta, ids)[1]


@given(probabilities)
def test_lrent_s_condition_is_that_of_the_paper(p) -> None:
    selection, _ = select(Cbst(portion=0.5, labels="lrent"), p)
    y, theta = selection.soft, selection.thresholds
    np.testing.assert_allclose(y.sum(axis=1), 1)
    entropy = np.where(y > 0, y * np.log(np.maximum(y, 1e-300)), 0).sum(axis=1)
    paper = -(y * np.log(p)).sum(axis=1) + 0.25 * entropy
    bound = -(y * np.log(theta)).sum(axis=1)
    clear = np.abs(paper - bound) > 1e-9
    assert (selection.selected == (paper < bound))[clear].all()
    hard, _ = select(Cbst(portion=0.5), p)
    assert (selection.selected | ~hard.selected | ~clear).all()  # keeps what CBST keeps


def test_thresholds_at_ties_and_empty_classes() -> None:
    confidence, predicted = np.array([0.7, 0.7, 0.7, 0.9, 0.6]), np.array([0, 0, 0, 0, 1])
    assert class_thresholds(confidence, predicted, 3, 0.5).tolist() == [0.7, 1.0, 1.0]
    assert class_thresholds(confidence, predicted, 3, 1.0).tolist() == [0.7, 0.6, 1.0]
    ten = np.linspace(0.5, 0.95, 10)  # 0.3 * 10 is 3, although 0.1 + 0.2 > 0.3
    assert class_thresholds(ten, np.zeros(10, int), 1, 0.3)[0] == ten[7]


def test_portion_grows_and_stops() -> None:
    portions = [Cbst().portion_of(r) for r in range(9)]
    assert portions == [0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.5, 0.5]


@given(probabilities, thetas, st.sampled_from(["confident", "all"]))
def test_random_keeps_as_many_of_each_class(p, theta, pool) -> None:
    ids = [f"{i:02d}" for i in range(len(p))]
    given_, _ = select(Qbst(), p, theta, ids)
    drawn, _ = select(Random(Qbst(), seed=1, pool=pool), p, theta, ids)
    predicted = p.argmax(axis=1)
    assert np.bincount(predicted[drawn.selected], minlength=4).tolist() == given_.kept.tolist()


def test_random_draws_each_sample_equally_often() -> None:
    p = np.column_stack([np.linspace(0.81, 0.99, 12), np.linspace(0.19, 0.01, 12)])
    p = np.concatenate([p, p[:, ::-1]])  # 12 of each class: QBST keeps the 6 most confident
    ids = [f"cloud {i}" for i in range(24)]
    hits = np.zeros(24)
    for seed in range(300):
        selection, _ = select(Random(Qbst(), seed=seed), p, 0.8, ids)
        assert selection.selected.sum() == 12
        hits += selection.selected
    assert abs(hits / 300 - 0.5).max() < 0.12  # four standard deviations
    first, second = (select(Random(Qbst()), p, 0.8, ids, r)[1] for r in (0, 1))
    assert first != second  # each round draws anew


def test_random_takes_its_defaults_and_says_whose_thresholds_it_has() -> None:
    assert Random(Qbst()).needs_features is False
    table = [[0.9 - 0.01 * i, 0.1 + 0.01 * i] for i in range(30)]
    table += [row[::-1] for row in table]
    ids = [f"{i:02d}" for i in range(60)]
    assert (
        select(Random(Qbst()), table, 0.7, ids)[1]
        == select(Random(Qbst(), seed=0, pool="confident"), table, 0.7, ids)[1]
    )
    assert (
        select(Random(Qbst(), seed=1), table, 0.7, ids)[1]
        != (select(Random(Qbst()), table, 0.7, ids)[1])
    )
    p = np.array(table).max(axis=1)
    assert (p[select(Random(Qbst()), table, 0.7, ids)[0].selected] > 0.7).all()
    assert (p[select(Random(Qbst(), pool="all"), table, 0.7, ids)[0].selected] <= 0.7).any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"portion": 0.0}, {"portion": -0.1}, {"portion": 1.1}, {"most": 1.1}, {"most": 0.0},
        {"step": -0.1}, {"alpha": 0.0}, {"labels": "soft"},
    ],
)  # fmt: skip
def test_settings_out_of_their_range_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Cbst(**wrong)
    assert Cbst(portion=1.0, most=1.0, step=0).portion_of(3) == 1.0
    for odd in ({"pool": "some"}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(odd))):
            Random(Qbst(), **odd)
