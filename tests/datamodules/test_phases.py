from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.datamodules.phases import Phases, SelfTrainingConfig, no_rounds
from qs3.errors import ConfigError
from qs3.selftraining.selectors import Qbst


def test_epochs_belong_to_phases():
    phases = Phases(warmup=3, rounds=2, epochs=2)
    assert phases.total == 7
    assert [phases.phase(e) for e in range(8)] == [0, 0, 0, 1, 1, 2, 2, 2]
    assert [e for e in range(7) if phases.starts(e)] == [0, 3, 5]
    assert [e for e in range(7) if phases.ends(e)] == [2, 4, 6]


def test_each_phase_has_its_own_cosine():
    phases = Phases(warmup=4, rounds=1, epochs=2)
    assert [round(phases.cosine(e), 4) for e in range(6)] == [1, 0.8536, 0.5, 0.1464, 1, 0.5]


def test_without_rounds_all_is_warmup():
    phases = Phases(warmup=3)
    assert (phases.total, phases.phase(2), phases.ends(2)) == (3, 0, True)


def test_theta_grows_without_rounding_error():
    scheme = SelfTrainingConfig(Qbst(), rounds=10, theta=0.8, epsilon=0.005)
    assert [scheme.theta_of(j) for j in (0, 3, 9)] == [0.8, 0.815, 0.845]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"theta": 0.0}, r"theta must be in \(0, 1\), got 0.0"),
        ({"theta": 1.0}, r"theta must be in \(0, 1\)"),
        ({"theta": 0.9, "epsilon": 0.02, "rounds": 6}, r"theta \+ epsilon .* got 1.0"),
        ({"theta": "abc"}, r"selftraining\.theta must be a number, got 'abc'"),
        ({"epsilon": None}, r"selftraining\.epsilon must be a number"),
        ({"rounds": -1}, "selftraining.rounds"),
        ({"rounds": "abc"}, r"selftraining\.rounds .* got 'abc'"),
        ({"epochs": 0}, "selftraining.epochs"),
        ({"batch_size": 1}, "selftraining.batch_size"),
        ({"init": "warm"}, "selftraining.init"),
        ({"missing_class": "ignore"}, "selftraining.missing_class"),
        ({"selector": None}, "needs a selector"),
    ],
)
def test_wrong_settings_name_the_key(settings, message):
    with pytest.raises(ConfigError, match=message):
        SelfTrainingConfig(**{"selector": Qbst(), "rounds": 2, **settings})


def test_none_ignores_what_an_experiment_set_for_rounds():
    assert no_rounds(rounds=3, epochs=2).rounds == 0


@pytest.mark.parametrize("epochs", [0, "abc", 1.5])
def test_warmup_needs_an_epoch(epochs):
    with pytest.raises(ConfigError, match=r"protocol\.epochs must be a whole number >= 1"):
        Phases(warmup=epochs)


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


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ((2, None), r"protocol\.steps=2 must be at least protocol\.epochs=3"),
        ((None, 3), r"selftraining\.steps=3 must be at least selftraining\.epochs=4"),
        ((0, None), r"protocol\.steps"),
    ],
)
def test_an_epoch_without_a_step_is_refused(steps, message):
    with pytest.raises(ConfigError, match=message):
        Phases(3, 2, 4, *steps)
