from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from qs3.config.checks import check_bool, check_choice, check_float, check_int, check_ranges
from qs3.errors import ConfigError


@pytest.mark.parametrize("value", [None, "1", 1.0, True, 0])
def test_int(value):
    assert check_int("a.b", 1, 1) == 1
    assert type(check_int("a.b", np.int16(3), 1)) is int
    with pytest.raises(ConfigError, match=r"a\.b must be a whole number >= 1, got"):
        check_int("a.b", value, 1)


@pytest.mark.parametrize("value", [None, "abc", True])
def test_float(value):
    assert check_float("a.b", 0.5) == 0.5
    with pytest.raises(ConfigError, match=r"a\.b must be a number, got"):
        check_float("a.b", value)


@pytest.mark.parametrize("value", [float("inf"), float("-inf"), float("nan")])
def test_what_is_not_finite_is_no_setting(value):
    with pytest.raises(ConfigError, match=rf"a\.b must be a finite number, got {value}"):
        check_float("a.b", value)
    for allowed in (">= 0", "> 0", "[0, 1]", "[0, inf)"):
        with pytest.raises(ConfigError, match=rf"a\.b must be .*, got {value}"):
            check_float("a.b", value, allowed)
        with pytest.raises(ConfigError, match=r"sensor\.a_m must be"):
            check_ranges(SimpleNamespace(a_m=value), "sensor.", a_m=allowed)


def test_choice():
    assert check_choice("a.b", "x", ("x", "y")) == "x"
    with pytest.raises(ConfigError, match=r"a\.b must be one of \('x', 'y'\), got 'z'"):
        check_choice("a.b", "z", ("x", "y"))


@pytest.mark.parametrize(
    ("allowed", "good", "bad"),
    [
        ("> 0", [0.1, 5, None], [0, -1, float("nan"), "1", True]),
        (">= 1", [1, 7.5], [0, 0.99]),
        ("[0, 1)", [0, 0.99], [-0.01, 1]),
        ("(0, 0.5]", [0.01, 0.5], [0, 0.51]),
        ("odd >= 3", [3, 9], [1, 4, 3.5]),
        ("odd [1, 5]", [1, 5], [2, 7, -1]),
    ],
)
def test_ranges(allowed, good, bad):
    for value in good:
        check_ranges(SimpleNamespace(a_m=value, b=-1), a_m=allowed)
    for value in bad:
        with pytest.raises(ConfigError) as error:
            check_ranges(SimpleNamespace(a_m=value), "sensor.", a_m=allowed)
        word = "in " if allowed[0] in "[(" else ""
        assert str(error.value) == f"sensor.a_m must be {word}{allowed}, got {value!r}"


def test_bool_and_float_in_a_range():
    assert check_bool("a.b", False) is False
    with pytest.raises(ConfigError, match=r"a\.b must be true or false, got 'yes'"):
        check_bool("a.b", "yes")
    assert check_float("a.b", 0.5, "[0, 1]") == 0.5
    with pytest.raises(ConfigError, match=r"a\.b must be in \[0, 1\], got 2"):
        check_float("a.b", 2, "[0, 1]")
