from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.datamodules.phases import Phases, SelfTrainingConfig, no_rounds, plain_epochs
from qs3.errors import ConfigError
from qs3.selftraining.baselines import Random
from qs3.selftraining.cbst import Cbst
from qs3.selftraining.sd import GraphRefined
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


def test_the_settings_of_a_schedule_cannot_be_changed_while_it_runs():
    for made, key in ((Phases(3), "warmup"), (SelfTrainingConfig(), "rounds")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(made, key, 4)


def test_what_is_not_said_is_the_paper_s():
    """Sec. 5.1: ten epochs a round, batches of 32, theta 0.8; nothing that other methods add."""
    assert dataclasses.asdict(SelfTrainingConfig()) == {
        "selector": None,
        "rounds": 0,
        "epochs": 10,
        "steps": None,
        "batch_size": 32,
        "theta": 0.8,
        "epsilon": 0.0,
        "share": None,
        "init": "scratch",
        "use_source": False,
        "pcm": False,
        "weight_step": 0.0,
        "mrkld": 0.0,
        "missing_class": "warn",
        "rehearsal": False,
    }
    assert dataclasses.astuple(Phases(3)) == (3, 0, 0, None, None)


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
        ({"share": 0.0}, r"selftraining\.share must be in \(0, 1\), got 0.0"),
        ({"share": 1.0}, r"selftraining\.share must be in"),
        ({"share": 0.5, "selector": Cbst(), "theta": 0.0}, r"share .* its own; set .*share=null"),
    ],
)
def test_wrong_settings_name_the_key(settings, message):
    with pytest.raises(ConfigError, match=message):
        SelfTrainingConfig(**{"selector": Qbst(), "rounds": 2, **settings})


def test_a_share_is_of_those_above_the_round_s_threshold():
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


def test_the_smallest_settings_are_allowed():
    scheme = SelfTrainingConfig(Qbst(), rounds=1, epochs=1, batch_size=2, theta=0.01, mrkld=0)
    assert (scheme.epochs, scheme.batch_size, scheme.theta_of(0)) == (1, 2, 0.01)


def test_a_threshold_of_0_is_for_selectors_with_their_own():
    assert SelfTrainingConfig(Cbst(), rounds=2, theta=0.0).theta_of(1) == 0.0
    for theta in (1.0, -0.1, 1.5):
        with pytest.raises(ConfigError, match=r"theta must be in \(0, 1\)"):
            SelfTrainingConfig(Cbst(), rounds=2, theta=theta)
    with pytest.raises(ConfigError, match=r"theta \+ epsilon \* \(rounds - 1\) .* got -0\.1 "):
        SelfTrainingConfig(Cbst(), rounds=2, theta=0.0, epsilon=-0.1)


@pytest.mark.parametrize(
    ("theta", "epsilon", "rounds"),
    [(0.5, 0.25, 3), (0.5, -0.25, 3), (0.9, 0.2, 2), (0.1, -0.2, 2)],
    ids=["reaches 1", "reaches 0", "passes 1", "passes 0"],
)
@pytest.mark.parametrize("selector", [Qbst(), Cbst()], ids=["qbst", "cbst"])
def test_the_last_round_s_threshold_lies_in_between(selector, theta, epsilon, rounds):
    with pytest.raises(ConfigError, match=r"theta \+ epsilon \* \(rounds - 1\)"):
        SelfTrainingConfig(selector, rounds=rounds, theta=theta, epsilon=epsilon)
    before = SelfTrainingConfig(selector, rounds=rounds - 1, theta=theta, epsilon=epsilon)
    assert 0 < before.theta_of(rounds - 2) < 1


def test_the_weight_of_the_losses_stays_above_0():
    """1 - step (e - 1) in the last of e = 3 * 4 epochs: 11 steps of 1/11 are one too many."""
    kept = SelfTrainingConfig(Qbst(), rounds=3, epochs=4, weight_step=0.0909)
    assert math.isclose(1 - kept.weight_step * 11, 0.0001)
    for step in (0.0910, 1 / 11, 0.5, -0.01):
        with pytest.raises(ConfigError, match=r"weight_step .* below 1 after 11 epochs, got"):
            SelfTrainingConfig(Qbst(), rounds=3, epochs=4, weight_step=step)
    assert SelfTrainingConfig(Qbst(), rounds=1, epochs=1, weight_step=5.0).weight_step == 5.0


def test_none_ignores_what_an_experiment_set_for_rounds():
    assert no_rounds(rounds=3, epochs=2).rounds == 0


@pytest.mark.parametrize(
    ("plain", "epochs", "first"),
    [(0.07, 100, 7), (0.07, 101, 8), (0.1, 100, 10), (0.1, 3, 1), (0, 1, 0), (0.14, 50, 7)],
)
def test_plain_epochs_by_hand(plain, epochs, first):
    assert plain_epochs(plain, epochs) == first


def test_the_default_s_plain_epochs_are_those_of_whole_numbers():
    for epochs in range(2, 500):
        assert plain_epochs(0.1, epochs) == -(-epochs // 10) == math.ceil(0.1 * epochs)


@pytest.mark.parametrize(("plain", "epochs"), [(0.1, 1), (0.95, 19), (0.7, 3)])
def test_an_epoch_must_be_left_for_a_pool(plain, epochs):
    with pytest.raises(ConfigError, match=rf"plain={plain} of protocol\.epochs={epochs}, rounded"):
        plain_epochs(plain, epochs)


@pytest.mark.parametrize("selector", [GraphRefined(unsure=0), Random(GraphRefined(unsure=0.0))])
def test_a_round_in_which_nothing_weighs_anything_is_refused(selector):
    kept = SelfTrainingConfig(selector, rounds=1, theta=0, use_source=True)
    with pytest.raises(ConfigError, match=r"unsure=0 and selftraining\.use_source=false: in round"):
        replace(kept, use_source=False)
    with_weight = Random(GraphRefined(unsure=1e-9))
    assert not replace(kept, use_source=False, selector=with_weight).use_source


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
        ((0, None), r"protocol\.steps must be a whole number >= 1"),
    ],
)
def test_an_epoch_without_a_step_is_refused(steps, message):
    with pytest.raises(ConfigError, match=message):
        Phases(3, 2, 4, *steps)


def test_no_threshold_of_0_is_advised_to_be_lowered():
    for selector, theta, share, ways in (
        (GraphRefined(), 0.0, None, ()),
        (GraphRefined(), 0.3, None, ("lower selftraining.theta",)),
        (GraphRefined(), 0.3, 0.5, ("raise selftraining.share",)),
        (Cbst(), 0.0, None, (Cbst.more_labels,)),
        (Cbst(), 0.3, 0.5, ("raise selftraining.share", Cbst.more_labels)),
    ):
        scheme = SelfTrainingConfig(selector, rounds=1, theta=theta, share=share)
        assert scheme.more_labels == ways
