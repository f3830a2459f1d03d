"""`evaluation.prior`: the reported probabilities are weighed, and nothing else of a run changes."""

from __future__ import annotations

import numpy as np
import pytest

from qs3.config import hashing
from qs3.errors import ConfigError
from qs3.evaluation.prior import read_prior
from qs3.runs.predictions import read_predictions
from qs3.training.command import headline, train
from tests.training.toy import CLASSES

WORDS = ("method=source_only", "selftraining=none", "protocol.epochs=2", "evaluation.rotations=2")


def test_the_reported_probabilities_are_weighed_and_estimates_are_not(toy) -> None:
    plain = toy(*WORDS)
    told = toy(*WORDS, "evaluation.prior={rod: 9, slab: 0}", "evaluation.prior_power=1.0")
    before, after = train(plain), train(told)
    of_plain, of_told = (
        read_predictions(hashing.run_folder(cfg) / "predictions.csv") for cfg in (plain, told)
    )
    prior = read_prior({"rod": 9, "slab": 0}, CLASSES, power=1.0)  # toys are balanced
    expected = prior(of_plain.probabilities)
    np.testing.assert_allclose(of_told.probabilities, expected)
    assert not (of_told.probabilities.argmax(axis=1) == CLASSES.index("slab")).any()
    right = (of_told.probabilities.argmax(axis=1) == of_told.labels).mean()
    assert after.final.accuracy == pytest.approx(right)
    assert after.warmup.selected.scores == after.final
    assert after.evaluation.final_over_rotations != before.evaluation.final_over_rotations
    assert after.evaluation.prior == prior.words
    assert before.evaluation.prior == ""
    assert "; with evaluation.prior; data: " in headline(after)
    assert "evaluation.prior" not in headline(before)
    assert after.quality == before.quality
    assert after.validators == before.validators


def test_runs_without_it_have_the_hash_that_they_had(toy) -> None:
    plain, power = toy(*WORDS), toy(*WORDS, "evaluation.prior_power=0.7")
    told = [toy(*WORDS, f"evaluation.prior={words}") for words in ("rooms", "{rod: 2}", "{rod: 3}")]
    hashes = [hashing.config_hash(cfg) for cfg in (plain, power, *told)]
    assert hashes[0] == hashes[1]
    assert len(set(hashes)) == 4


@pytest.mark.parametrize("words", ["rooms", "{unicorn: 2}", "{rod: -1}", "3"])
def test_what_is_no_prior_ends_a_run_before_it_trains(toy, words: str) -> None:
    cfg = toy(*WORDS, f"evaluation.prior={words}")
    with pytest.raises(ConfigError, match="prior="):
        train(cfg)
    assert not list(hashing.run_folder(cfg).glob("*.ckpt"))
