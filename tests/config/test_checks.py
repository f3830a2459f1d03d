from __future__ import annotations

import pytest

from qs3.config.checks import number, one_of, whole
from qs3.errors import ConfigError


@pytest.mark.parametrize("value", [None, "1", 1.0, True, 0])
def test_whole(value):
    assert whole("a.b", 1, 1) == 1
    with pytest.raises(ConfigError, match=r"a\.b must be a whole number >= 1, got"):
        whole("a.b", value, 1)


@pytest.mark.parametrize("value", [None, "abc", True])
def test_number(value):
    assert number("a.b", 0.5) == 0.5
    with pytest.raises(ConfigError, match=r"a\.b must be a number, got"):
        number("a.b", value)


def test_one_of():
    assert one_of("a.b", "x", ("x", "y")) == "x"
    with pytest.raises(ConfigError, match=r"a\.b must be one of \('x', 'y'\), got 'z'"):
        one_of("a.b", "z", ("x", "y"))
