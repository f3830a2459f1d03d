"""YAML that stands for more than there is memory, and YAML that is only long."""

from __future__ import annotations

import pytest

from qs3.errors import DataError
from qs3.utils.yamls import MOST_VALUES, check_yaml, load_yaml
from tests.limits import time_of_at_most


def laughs(levels: int) -> str:
    """Ten to the power of `levels` words in some lines."""
    lines = ["a0: &a0 [x,x,x,x,x,x,x,x,x,x]"]
    for i in range(1, levels):
        lines.append(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]")
    return "\n".join(lines)


def test_aliases_are_counted_as_often_as_they_are_followed():
    check_yaml(laughs(4), "x")  # 1 + 11 + 111 + 1111 + 11111 values, and keys
    assert len(laughs(9)) < 500
    with time_of_at_most(10), pytest.raises(DataError, match=f"^x: more than {MOST_VALUES} values"):
        check_yaml(laughs(9), "x")
    with pytest.raises(DataError, match="x: more than"):
        check_yaml(laughs(5), "x")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [1, *a]", r"\*a stands for itself"),
        ("a: *b", r"\*b stands for itself, or for nothing"),
        ("[" * 500, "deeper than 64"),
        ("a: [1", "x is not readable: while parsing"),
        ("a: \0", "x is not readable: unacceptable character"),
    ],
)
def test_what_is_refused(text, message):
    with time_of_at_most(10), pytest.raises(DataError, match=message):
        check_yaml(text, "x")


@pytest.mark.parametrize("text", ["a: 2020-99-99", f"a: {'1' * 5000}", "? [1]\n: 2", "a: !!x 1"])
def test_values_that_python_does_not_know_are_told(text):
    check_yaml(text, "x")
    with pytest.raises(DataError, match=r"^x is not readable: "):
        load_yaml(text, "x")


def test_what_people_write_is_let_through():
    text = "camera: &c {fx: 500, fy: 500}\nrows:\n- {<<: *c, depth: a.png}\n- {<<: *c}\n- &n null\n"
    check_yaml(text, "x")
    assert load_yaml(text, "x")["rows"][0]["fx"] == 500
    check_yaml("", "x")
    check_yaml("\n".join(f"- {i}" for i in range(2000)), "x")
