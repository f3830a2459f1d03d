"""What is expected of answers without labels: each shift by hand, properties, and the fit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import DataError
from qs3.evaluation.estimates_text import DO_NOT_TRUST, reasons, trust_in_words
from qs3.evaluation.trust import (
    FEWEST,
    Known,
    Seen,
    centred_logs,
    counts_apart,
    expected,
    far_share,
    fit_weights,
    judge,
    logit,
    outside_share,
    shifts,
)
from qs3.evaluation.trust_file import PATH, SHIFTS, Calibration, read_calibration, write_calibration
from qs3.runs.metrics import Trust

CALIBRATION = Calibration({"unsure": 0.5, "answers": 1.0, "shapes": 1.5}, 50, 8, 0.08, 0.16, 0.2)


def answers(n: int, right: float, seed: int, classes: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A net's probabilities of n clouds, of which about the share `right` is right, and labels."""
    rng = np.random.default_rng(seed)
    labels = np.arange(n) % classes
    named = np.where(rng.random(n) < right, labels, rng.integers(0, classes, n))
    logits = rng.normal(size=(n, classes)) + 4 * np.eye(classes)[named]
    weights = np.exp(logits)
    return weights / weights.sum(axis=1, keepdims=True), labels


def shapes(n: int, seed: int, middle: float = 0.0) -> np.ndarray:
    return middle + np.random.default_rng(seed).normal(size=(n, 4))


def net(right: float = 0.9, v: int = 200) -> Known:
    table, labels = answers(v, right, 0)
    return Known(table, labels, shapes(300, 0))


def test_far_by_hand():
    line = np.arange(101.0)[:, None]  # its own fifth neighbours are 3 away, at the ends up to 5
    spaced = np.array([[50.0], [300.0], [-200.0], [20.0]])
    assert far_share(line, spaced) == pytest.approx((0.5 - 0.1) / 0.9)
    assert far_share(line, spaced[[0, 3]]) == 0
    assert far_share(line[:1], spaced) == 0  # nothing to compare with


def test_columns_count_alike_in_any_unit():
    units, own, others = np.array([1, 1000, 1e-3, 1]), shapes(200, 1), shapes(100, 2, 0.7)
    assert far_share(own, others) > 0.1
    assert far_share(own * units, others * units) == pytest.approx(far_share(own, others))


def test_a_reference_of_two_kinds_has_an_outside_between_them_and_none_in_them():
    two = np.concatenate([shapes(200, 1), shapes(200, 2, 50.0)])
    assert far_share(two, shapes(100, 3)) < 0.1
    assert far_share(two, shapes(100, 4, 50.0)) < 0.1
    assert far_share(two, shapes(100, 5, 25.0)) == 1


def test_outside_by_hand():
    reference = np.stack([np.linspace(0, 1, 1001), np.linspace(5, 6, 1001)], axis=1)
    others = np.array([[0.5, 5.5], [0.0005, 5.5], [0.5, 6.2], [0.999, 5.001]])
    assert outside_share(reference, others) == 0.5


def test_counts_by_hand():
    def named(*counts: int) -> np.ndarray:
        return np.eye(len(counts))[np.repeat(np.arange(len(counts)), counts)]

    assert counts_apart(named(50, 50), named(5, 5)) == 0
    # 1/2 (|0.5 - 1| + |0.5 - 0|) less chance: of 200 clouds 3/4 and 1/4, sd sqrt(3/16 * 2/100)
    chance = math.sqrt(2 / math.pi) * math.sqrt(3 / 16 * 2 / 100)
    assert counts_apart(named(50, 50), named(100, 0)) == pytest.approx(0.5 - chance)
    assert counts_apart(named(1, 1), named(2, 0)) < 0.5 - chance  # few clouds say less


def test_chance_alone_moves_no_counts_on_average():
    rng = np.random.default_rng(0)
    found = [
        counts_apart(np.eye(6)[rng.integers(0, 6, 150)], np.eye(6)[rng.integers(0, 6, 90)])
        for _ in range(200)
    ]
    assert np.mean(found) < 0.03


def test_centred_logs_are_the_logits_but_for_a_constant():
    logits = np.random.default_rng(0).normal(size=(7, 4))
    table = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    wanted = logits - logits.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(centred_logs(table), wanted, atol=1e-12)
    assert np.isfinite(centred_logs(np.eye(3))).all()


def test_an_estimate_by_hand():
    assert expected(0.8, {"shapes": 0.5, "answers": 9.0}, {"shapes": 2.0}) == pytest.approx(
        1 / (1 + math.exp(1 - math.log(4)))
    )
    with pytest.raises(DataError, match="lacks turns"):
        expected(0.8, {"shapes": 0.5}, {"shapes": 1.0, "turns": 1.0})


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.65, 1), st.integers(60, 250))
def test_the_labelled_domain_itself_is_never_refused(seed, right, n):
    """Other clouds of the same kind: about the held-out accuracy is expected, and no more."""
    table, labels = answers(n, right, seed)
    known = Known(table, labels, shapes(300, seed))
    other = Seen(answers(n, right, seed + 1)[0], shapes(n, seed + 1))
    for seen in (Seen(known.probabilities, known.measures), other):
        trust = judge(known, seen, CALIBRATION)
        assert trust.trusted
        assert trust.expected <= known.accuracy + 1e-9
    assert judge(known, other, CALIBRATION).expected > known.accuracy - 0.2


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.dictionaries(st.sampled_from([*SHIFTS]), st.floats(0, 5), min_size=1),
    st.sampled_from([*SHIFTS]),
    st.floats(0, 1),
)
def test_no_shift_ever_raises_an_estimate(seed, weights, name, more):
    rng = np.random.default_rng(seed)
    found = dict(zip(SHIFTS, rng.random(len(SHIFTS)).tolist(), strict=True))
    larger = {**found, name: found[name] + more}
    assert expected(0.7, larger, weights) <= expected(0.7, found, weights)


def test_answers_that_are_surer_than_those_to_labelled_clouds_gain_nothing():
    known = net(right=0.7)
    sure = np.full((100, 5), 1e-9) + np.eye(5)[np.arange(100) % 5]
    seen = Seen(sure / sure.sum(axis=1, keepdims=True), known.measures)
    found = shifts(known, seen)
    assert found["unsure"] == found["thresholded"] == 0
    assert judge(known, seen, CALIBRATION).expected <= known.accuracy


def test_noise_is_refused_and_the_words_say_why():
    noise = np.random.default_rng(1).dirichlet(np.full(5, 0.3), 100)
    trust = judge(net(), Seen(noise, shapes(100, 1, 8.0)), CALIBRATION)
    assert not trust.trusted
    words = trust_in_words(trust)
    assert words.startswith(f"{DO_NOT_TRUST}: about {trust.expected:.0%} expected to be right: ")
    assert SHIFTS["shapes"] + " (1.00)" in words


def test_a_poor_net_is_refused_on_its_own_clouds_because_it_is_poor():
    known = net(right=0.2)
    trust = judge(known, Seen(known.probabilities, known.measures), CALIBRATION)
    assert not trust.trusted
    assert "even of held-out labelled clouds" in trust_in_words(trust)


def test_of_few_clouds_nothing_is_said():
    known = net()
    some = Seen(known.probabilities[: FEWEST - 1], known.measures[: FEWEST - 1])
    assert judge(known, some, CALIBRATION) is None
    assert judge(known, Seen(known.probabilities[:FEWEST], known.measures), CALIBRATION)


def test_turns_count_where_they_were_asked():
    known = net()
    table = known.probabilities
    assert "turns" not in shifts(known, Seen(table, known.measures, 0.5))
    known = Known(table, known.labels, known.measures, turns=0.9)
    assert shifts(known, Seen(table, known.measures, 0.6))["turns"] == pytest.approx(0.3)
    assert shifts(known, Seen(table, known.measures, 0.95))["turns"] == 0


def test_the_weights_are_found_that_made_the_accuracies():
    rng = np.random.default_rng(0)
    table, base = rng.random((400, 3)), rng.uniform(0.6, 0.95, 400)
    wanted = {"unsure": 1.5, "answers": 0.0, "shapes": 2.0}
    truth = np.array(
        [
            expected(b, dict(zip(wanted, row, strict=True)), wanted)
            for b, row in zip(base, table, strict=True)
        ]
    )
    targets = [f"t{i % 8}" for i in range(400)]
    found = fit_weights([*wanted], table, base, truth, targets)
    assert found == pytest.approx(wanted, abs=0.2)
    assert found["unsure"] < 1.5  # the ridge


def test_what_would_raise_an_estimate_gets_no_weight():
    table, base = np.random.default_rng(0).random((50, 1)), np.full(50, 0.6)
    truth = base + 0.3 * table[:, 0]
    assert fit_weights(["shapes"], table, base, truth, ["a", "b"] * 25) == {"shapes": 0}


def test_logits_are_bounded():
    assert logit(0) == logit(0.01) == pytest.approx(-logit(1))
    assert logit(0.5) == 0


def test_the_calibration_that_comes_with_qs3_is_whole(tmp_path):
    found = read_calibration()
    assert found.cases >= 40
    assert found.targets >= 6
    write_calibration(tmp_path / "again.json", found)
    assert (tmp_path / "again.json").read_bytes() == PATH.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": {"shapes": -1}}, "weights.shapes"),
        ({"weights": {"mood": 1}}, "weights: .*should be weights of"),
        ({"weights": {}}, "weights"),
        ({"mean_error": 2}, "mean_error"),
        ({"more": 1}, "more"),
        ({"cases": None}, "cases"),
    ],
)
def test_a_damaged_calibration_is_named(tmp_path, change, message):
    path = tmp_path / "weights.json"
    path.write_text(json.dumps({**json.loads(PATH.read_text()), **change}))
    with pytest.raises(DataError, match=rf"weights\.json is damaged: {message}.*install qs3 again"):
        read_calibration(path)


def test_a_calibration_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DataError, match=r"x\.json cannot be read"):
        read_calibration(tmp_path / "x.json")


def test_words_of_an_estimate_that_can_be_trusted():
    known = net()
    trust = judge(known, Seen(known.probabilities, known.measures), CALIBRATION)
    words = trust_in_words(trust)
    assert words.startswith(f"about {trust.expected:.0%} expected to be right, give or take 8 poi")
    assert DO_NOT_TRUST not in words
    assert reasons(trust) == [] or all("(0." in one for one in reasons(trust))


def test_the_trial_of_the_docs_ends_as_a_run_with_its_figures_does():
    """docs/how-to/adapt.md shows that run's output; other weights or words make another line."""
    found = {
        "unsure": 0.5096618, "thresholded": 0.4769241, "answers": 0.1481481,
        "shapes": 0.2345679, "outside": 0.0555556, "counts": 0.1661760,
    }  # fmt: skip
    weights, held_out = read_calibration().weights, 0.7073171
    trust = Trust(
        expected=expected(held_out, found, weights),
        trusted=False,
        held_out=held_out,
        shifts=found,
        lost={name: weight * found[name] for name, weight in weights.items()},
        error=read_calibration().mean_error,
        error_90=read_calibration().error_90,
    )
    page = Path(__file__).parents[2] / "docs" / "how-to" / "adapt.md"
    shown = " ".join(page.read_text("utf-8").split())
    assert f"; {trust_in_words(trust)} (of the net before self-training); data: " in shown
