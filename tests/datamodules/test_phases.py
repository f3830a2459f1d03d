from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.datamodules.phases import Phases, SelfTrainingConfig, no_rounds
from qs3.errors import ConfigError
from qs3.selftraining.cbst import Cbst
from qs3.selftraining.selectors import Qbst


def test_epochs_belong_to_phases():
    phases = Phases(warmup=3, rounds=2, epochs=2)
    assert phases.total == 7
    assert [phases.phase(e) for e in range(8)] == [0, 0, 0, 1, 1, 2, 2, 2]
    assert [e for e in range(7) if phases.starts(e)] == [0, 3, 5]
    assert [e for e in range(7) if phases.ends(e)] == [2, 4, 6]


@given(warmup=st.integers(1, 300), rounds=st.integers(0, 5), epochs=st.integers(1, 300))
def test_phases_are_a_list_of_epochs_cut_into_pieces(warmup, rounds, epochs):
    phases = Phases(warmup, rounds, epochs)
    written_out = [0] * warmup + [r for r in range(1, rounds + 1) for _ in range(epochs)]
    assert phases.total == len(written_out)
    assert [phases.phase(e) for e in range(phases.total)] == written_out
    for epoch, phase in enumerate(written_out):
        around = (written_out[epoch - 1] if epoch else None, *written_out[epoch + 1 : epoch + 2])
        assert phases.starts(epoch) is (around[0] != phase)
        assert phases.ends(epoch) is (len(around) == 1 or around[1] != phase)
    for phase in range(rounds + 1):
        first = written_out.index(phase)
        length = written_out.count(phase)
        assert phases.span(phase) == (first, first + length)
        for k in {0, length // 3, length - 1}:
            expected = (1 + math.cos(math.pi * k / length)) / 2
            assert math.isclose(phases.cosine(first + k), expected, abs_tol=1e-12)


def test_an_epoch_past_the_end_is_of_the_last_phase_and_ends_nothing():
    phases = Phases(warmup=3, rounds=2, epochs=2)
    assert [(phases.phase(e), phases.starts(e), phases.ends(e)) for e in (7, 8)] == [
        (2, False, False)
    ] * 2
    assert not Phases(warmup=3).starts(4)


def test_each_phase_has_its_own_cosine():
    phases = Phases(warmup=4, rounds=1, epochs=2)
    assert [round(phases.cosine(e), 4) for e in range(6)] == [1, 0.8536, 0.5, 0.1464, 1, 0.5]


def test_an_unbroken_cosine_rises_in_every_second_round():
    phases = Phases(warmup=2, rounds=3, epochs=2, unbroken=True)
    assert [round(phases.cosine(e), 4) for e in range(8)] == [1, 0.5, 1, 0.5, 0, 0.5, 1, 0.5]


def test_without_rounds_all_is_warmup():
    phases = Phases(warmup=3)
    assert (phases.total, phases.phase(2), phases.ends(2)) == (3, 0, True)


def test_theta_grows_without_rounding_error():
    scheme = SelfTrainingConfig(Qbst(), rounds=10, theta=0.8, epsilon=0.005)
    assert [scheme.theta_of(j, np.ones(1)) for j in (0, 3, 9)] == [0.8, 0.815, 0.845]


def test_a_share_is_of_those_above_the_threshold():
    scheme = SelfTrainingConfig(Qbst(), rounds=2, share=0.25)
    confidence = np.random.default_rng(0).random(101)
    for round_ in (0, 1):  # whatever epsilon says
        theta = scheme.theta_of(round_, confidence)
        assert (confidence > theta).sum() == 25
        assert theta == np.sort(confidence)[75]
    for equal in (np.ones(5), np.array([0.3, 1, 1, 1, 1])):
        assert ((equal > scheme.theta_of(0, equal)) == (equal == 1)).all()
    assert replace(scheme, share=None).theta_of(1, confidence) == 0.8
    assert SelfTrainingConfig(Cbst(), rounds=2, theta=0.8, share=0.5).share == 0.5


def test_none_ignores_what_an_experiment_set_for_rounds():
    assert no_rounds(rounds=3, epochs=2).rounds == 0


@given(
    warmup=st.integers(1, 20),
    rounds=st.integers(0, 4),
    epochs=st.integers(1, 9),
    more=st.tuples(st.integers(0, 500), st.integers(0, 500)),
)
def test_steps_are_spread_evenly_over_the_epochs_of_each_phase(warmup, rounds, epochs, more):
    steps = (warmup + more[0], epochs + more[1])
    phases = Phases(warmup, rounds, epochs, *steps)
    for phase in range(rounds + 1):
        pieces = [phases.steps(epoch) for epoch in range(*phases.span(phase))]
        assert pieces[0][0] == 0
        assert pieces[-1][1] == steps[min(phase, 1)]
        assert all(one[1] == two[0] for one, two in itertools.pairwise(pieces))
        sizes = [stop - first for first, stop in pieces]
        assert max(sizes) - min(sizes) <= 1
        assert min(sizes) >= 1


def test_without_steps_an_epoch_is_one_pass():
    assert Phases(3, 2, 4).steps(0) is None
    assert Phases(3, 2, 4, warmup_steps=30).steps(3) is None
    assert Phases(3, 2, 4, round_steps=30).steps(2) is None


def test_what_is_not_set_is_the_paper_s():
    """Sec. 5.1: ten epochs a round, batches of 32, theta 0.8; nothing that other methods add."""
    scheme = SelfTrainingConfig()
    assert (scheme.epochs, scheme.batch_size, scheme.theta, scheme.epsilon) == (10, 32, 0.8, 0)
    assert (scheme.init, scheme.share, scheme.steps) == ("scratch", None, None)
    assert (scheme.use_source, scheme.pcm, scheme.rehearsal) == (False, False, False)
    assert scheme.weight_step == scheme.mrkld == scheme.rounds == 0
    assert dataclasses.astuple(Phases(3)) == (3, 0, 0, None, None, False)


@pytest.mark.parametrize(
    "wrong",
    [
        {"theta": -0.1}, {"theta": 1.0}, {"rounds": -1}, {"epochs": 0}, {"batch_size": 1},
        {"steps": 0}, {"share": 0.0}, {"share": 1.0}, {"mrkld": -0.1}, {"weight_step": -0.01},
        {"init": "warm"},
    ],
)  # fmt: skip
def test_settings_out_of_their_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SelfTrainingConfig(**wrong)


def test_the_smallest_settings_are_allowed():
    scheme = SelfTrainingConfig(
        rounds=1, epochs=1, steps=1, batch_size=2, theta=0, mrkld=0, weight_step=0
    )
    assert (scheme.epochs, scheme.batch_size, scheme.theta_of(0, np.ones(1))) == (1, 2, 0)


def test_the_weight_of_the_losses_stays_above_0():
    """1 - step (e - 1) in the last of e = 3 * 4 epochs: 11 steps of 1/11 are one too many."""
    kept = SelfTrainingConfig(rounds=3, epochs=4, weight_step=0.0909)
    assert math.isclose(1 - kept.weight_step * 11, 0.0001)
    for step in (0.0910, 1 / 11, 0.5):
        with pytest.raises(ConfigError):
            SelfTrainingConfig(rounds=3, epochs=4, weight_step=step)
    assert SelfTrainingConfig(rounds=1, epochs=1, weight_step=5.0).weight_step == 5.0
