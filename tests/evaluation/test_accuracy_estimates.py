"""Estimates without labels: known answers, properties, and where they are known to fail."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qs3.config import hashing
from qs3.evaluation import confidences as quality
from qs3.evaluation.estimates_text import MEANINGS, in_words, table, trust_in_words
from qs3.report.run_page import draw
from qs3.runs.metrics import AccuracyEstimates, Estimates, Trust, read_metrics
from qs3.runs.predictions import OF_FILES, Predictions, write_predictions_of_files
from qs3.training.command import headline, train
from tests.training.toy import CLASSES, toy_config, write_domain


def two(*confident: float) -> np.ndarray:
    """Probabilities of two classes, the first one with these."""
    return np.array([[p, 1 - p] for p in confident])


def softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def drawn(n: int, sharpness: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Calibrated probabilities of four classes, and labels drawn from them."""
    rng = np.random.default_rng(seed)
    table = softmax(sharpness * rng.normal(size=(n, 4)))
    labels = (rng.random(n)[:, None] > table.cumsum(axis=1)).sum(axis=1).clip(max=3)
    return table, labels


TABLES = arrays(
    np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-20, 20)
).map(softmax)


@pytest.mark.parametrize("t", [0.3, 1.0, 3.0])
def test_the_temperature_is_found_that_the_logits_were_multiplied_by(t):
    table, labels = drawn(20000, 2.0)
    spoilt = softmax(t * np.log(table))  # T = t makes it calibrated again
    assert quality.temperature(spoilt, labels) == pytest.approx(t, rel=0.03)


@pytest.mark.parametrize("v", [1, 3, 60])
def test_a_net_that_is_always_right_is_as_sure_as_so_few_clouds_allow(v):
    """Right on v of v clouds: (v + 1) / (v + 2), Laplace's rule, whatever it said itself."""
    always = np.zeros(v, dtype=int)
    t = quality.temperature(two(*[0.7] * v), always)
    assert quality.scaled(two(0.7), t)[0, 0] == pytest.approx((v + 1) / (v + 2), abs=1e-4)


def test_a_target_does_not_become_certain_because_validation_held_no_error():
    """60 clouds, all right, and a target on which the net is as unsure as it is wrong."""
    source, _ = drawn(60, 3.0)
    target, truth = drawn(4000, 1.0, seed=1)
    right = (target.argmax(axis=1) == truth).mean()
    found = quality.estimates(source, source.argmax(axis=1), target)
    assert found["temperature"] > 0.3  # without Laplace's rule 0.05, and then all are certain
    assert right < found["calibrated"] < 0.8


def test_a_net_worse_than_chance_is_made_unsure():
    table = two(0.6, 0.7, 0.9)
    assert quality.temperature(table, np.ones(3, dtype=int)) > 19
    assert quality.scaled(table, 20.0).max() < 0.53


@given(TABLES, st.floats(0.1, 10))
def test_scaling_changes_no_class_and_can_be_undone(table, t):
    scaled = quality.scaled(table, t)
    assert np.allclose(scaled.sum(axis=1), 1)
    best = table.max(axis=1)
    clear = np.sort(table, axis=1)[:, -2] < best * (1 - 1e-6)
    assert (scaled.argmax(axis=1) == table.argmax(axis=1))[clear].all()
    mild = table.min(axis=1) > 1e-12
    assert np.allclose(quality.scaled(scaled, 1 / t)[mild], table[mild], atol=1e-6)


def test_thresholded_confidence_by_hand():
    source, labels = two(0.9, 0.8, 0.7, 0.6), np.array([0, 0, 1, 1])  # two errors, the least sure
    target = two(0.95, 0.85, 0.75, 0.55)
    assert quality.thresholded_confidence(source, labels, target) == 0.5  # t: score of 0.8
    assert quality.thresholded_confidence(source, labels, source) == 0.5
    # of whom the errors are does not matter, only how many
    assert quality.thresholded_confidence(source, labels[::-1], target) == 0.5
    assert quality.thresholded_confidence(source, np.zeros(4, dtype=int), target) == 0.75
    assert quality.thresholded_confidence(source, np.ones(4, dtype=int), target) == 0.0


@given(TABLES, st.integers(0, 2**20))
def test_on_the_source_itself_threshold_and_difference_give_its_accuracy(source, seed):
    labels = np.random.default_rng(seed).integers(3, size=len(source))
    accuracy = (source.argmax(axis=1) == labels).mean()
    assert quality.difference_of_confidences(source, labels, source) == pytest.approx(accuracy)
    found = quality.thresholded_confidence(source, labels, source)
    assert found >= accuracy - 1e-12  # equal but for ties at the threshold
    entropies = -(source * np.log(np.where(source > 0, source, 1))).sum(axis=1)
    if len(set(entropies)) == len(source):
        assert found == pytest.approx(accuracy)


@example(softmax(np.array([[2.0, 2, 2]] * 3 + [[0, 2, 2]])), softmax(np.zeros((1, 3))), 1)
@given(TABLES, TABLES, st.integers(0, 2**20))
def test_all_are_shares_and_need_no_order(source, target, seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(3, size=len(source))
    found = quality.estimates(source, labels, target)
    for name in ("mean_confidence", "calibrated", "thresholded", "difference"):
        assert 0 <= found[name] <= 1
    assert 0.049 < found["temperature"] < 20.1
    p, q = rng.permutation(len(source)), rng.permutation(len(target))
    again = quality.estimates(source[p], labels[p], target[q])
    assert all(math.isclose(again[k], found[k], rel_tol=1e-6, abs_tol=1e-9) for k in found)


def test_where_confidences_mean_the_same_two_are_right():
    """Other proportions of easy and hard clouds, but p(label | probabilities) as on the source.

    The third one counts clouds above a threshold and is far too low here, where all are unsure.
    """
    source, labels = drawn(8000, 2.5, seed=1)
    hard, truth = drawn(8000, 1.0, seed=2)
    accuracy = (hard.argmax(axis=1) == truth).mean()
    found = quality.estimates(source, labels, hard)
    assert (source.argmax(axis=1) == labels).mean() - accuracy > 0.15  # a real loss
    assert found["calibrated"] == pytest.approx(accuracy, abs=0.02)
    assert found["difference"] == pytest.approx(accuracy, abs=0.03)
    assert found["thresholded"] < accuracy - 0.2


def test_where_sure_clouds_are_wrong_all_three_are_too_high():
    """What no estimate from confidences can see: the same table, other labels."""
    source, labels = drawn(4000, 2.5)
    found = quality.estimates(source, labels, source)
    wrong = (source.argmax(axis=1) == (labels + 1) % 4).mean()
    assert min(found["calibrated"], found["thresholded"], found["difference"]) > wrong + 0.4


def test_agreements_by_hand():
    a, b = two(0.9, 0.8, 0.4, 0.3), two(0.6, 0.4, 0.1, 0.9)
    assert quality.agreement(a, b) == 0.5
    assert quality.rotation_agreement(a, [a, b]) == 0.75


def test_words_have_a_range_or_one_figure_and_nothing_without_estimates():
    some = {"calibrated": 0.712, "thresholded": 0.655, "difference": 0.74}
    always = {"clouds": 9, "validated_on": "source_val", "validation_clouds": 5}
    always |= {"validation_accuracy": 0.9, "unlike_source": 0.0}

    def said(**more):
        return AccuracyEstimates(**{**always, "never_predicted": [], **more})

    assert "alone 66% to 74%, which is too high as a rule" in in_words(said(**some))
    assert "71%, which" in in_words(said(**dict.fromkeys(some, 0.71)))
    taught = Estimates(validation_accuracy=0.8, **dict.fromkeys(some, 0.5))
    assert "71% (before self-training 50%), which" in in_words(
        said(**dict.fromkeys(some, 0.71), teacher=taught)
    )
    some_trust = Trust(
        expected=0.3, trusted=False, held_out=0.9, shifts={"shapes": 0.6}, lost={"shapes": 2.0},
        error=0.1, error_90=0.2,
    )  # fmt: skip
    words = in_words(said(**some, trust=some_trust))
    assert words.startswith("do not trust this: about 30% expected to be right: the clouds are sh")
    assert "too high" not in words
    assert in_words(said()) == in_words(said(**dict.fromkeys(some))) == ""
    rows = {row[0]: row[1:] for row in table(said(**some, never_predicted=["bed", "sofa"]))}
    assert list(rows) == [
        *("validation accuracy", "calibrated", "thresholded", "difference"),
        *("unlike source", "never predicted"),
    ]
    assert rows["calibrated"] == ("71.2%", MEANINGS["calibrated"] + ".")
    assert rows["never predicted"][0] == "bed, sofa"
    rows = {row[0]: row[1] for row in table(said(teacher=taught))}
    assert rows == {
        "validation accuracy": "90.0% (before self-training 80.0%)",
        "unlike source": "0.0%",
        "never predicted": "none",
    }


def test_the_table_of_files(tmp_path):
    p = Predictions(("a", "b"), ("2", "1"), ("2", "1"), np.full(2, -1), two(0.25, 0.875))
    path = tmp_path / OF_FILES
    write_predictions_of_files(path, ["z/ü.ply", "a,1.xyz"], ["", "height 9"], p)
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["file", "class", "confidence", "unlike_source", "reason", "p_a", "p_b"]
    assert rows[1] == ["a,1.xyz", "a", "0.8750", "yes", "height 9", "0.8750", "0.1250"]
    assert rows[2] == ["z/ü.ply", "b", "0.7500", "no", "", "0.2500", "0.7500"]


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    """The toy source, and 30 files of one's own in two folders."""
    root = tmp_path_factory.mktemp("quality")
    write_domain(root / "data", "specklenet10", noise=0.05)
    rng = np.random.default_rng(0)
    for i in range(30):
        path = root / "scans" / f"room{i % 2}" / f"{i:02d}.xyz"
        path.parent.mkdir(parents=True, exist_ok=True)
        shape = [(1.0, 1.0, 1.0), (0.2, 0.2, 1.0), (1.0, 1.0, 0.15)][i % 3]
        np.savetxt(path, rng.normal(size=(40 + i, 3)) * shape)
    return root


@pytest.fixture(scope="module")
def own(toy):
    """A finished run on them, and what it returned."""
    cfg = toy_config(
        toy,
        *("domain@data.target=own", f"data.target.published.folder={toy / 'scans'}"),
        *(
            "data.target.published.points=48",
            "data.target.published.layout=none",
            f"data.target.classes=[{','.join(CLASSES)}]",
        ),
    )
    return cfg, train(cfg)


def test_a_run_on_one_s_own_scans_says_what_it_can(own):
    cfg, metrics = own
    found = metrics.quality
    assert metrics.final.accuracy is None
    assert metrics.evaluation.labels is False
    assert all(record.mu.keys() == set(CLASSES) for record in metrics.rounds)
    assert found.clouds == sum(metrics.final.predicted.values()) == 30
    assert found.validated_on == "source_val"
    assert found.validation_clouds > 5
    shares = [*MEANINGS][:-1]
    assert all(0 <= getattr(found, name) <= 1 for name in shares)  # none is missing
    assert set(found.never_predicted) <= set(CLASSES)
    assert "no labels to judge own by; predicted " in headline(metrics)
    assert 0 <= found.teacher.calibrated <= 1
    assert found.trust.held_out <= 1
    assert trust_in_words(found.trust) in headline(metrics)
    assert "expected to be right" in headline(metrics)
    folder = hashing.run_folder(cfg)
    assert read_metrics(folder) == metrics
    html = draw(folder, embed=False).page.read_text()
    assert "Quality without labels" in html
    assert MEANINGS["thresholded"] in html


def test_each_file_has_its_class_under_its_own_name(own):
    cfg, metrics = own
    with open(hashing.run_folder(cfg) / OF_FILES, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == sorted(f"room{i % 2}/{i:02d}.xyz" for i in range(30))
    for name, count in metrics.final.predicted.items():
        assert sum(row["class"] == name for row in rows) == count
    for row in rows:
        assert sum(float(row[f"p_{name}"]) for name in CLASSES) == pytest.approx(1, abs=2e-4)
        assert row["confidence"] == row[f"p_{row['class']}"]
