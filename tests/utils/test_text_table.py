"""Tables as text: by hand."""

import csv
import io

from hypothesis import example, given
from hypothesis import strategies as st

from qs3.utils.text_table import aligned, csv_text, markdown

ROWS = [("class", "n"), ("a|b", "1000"), ("é", "5 %")]


def test_aligned_text():
    assert aligned(ROWS) == ["class  n", "-----  ----", "a|b    1000", "é      5 %"]
    assert aligned(ROWS, numbers=True, rule=False) == ["class     n", "a|b    1000", "é       5 %"]


def test_markdown():
    assert markdown(ROWS) == [
        "| class | n    |",
        "|-------|------|",
        r"| a\|b  | 1000 |",
        "| é     | 5 %  |",
    ]
    assert markdown(ROWS[:1], numbers=True) == ["| class | n |", "|-------|--:|"]


def test_csv():
    assert csv_text([["a", None, 0.1], ['x"y', "1,2", "two\nlines"]]) == (
        'a,,0.1\n"x""y","1,2","two\nlines"\n'
    )


@given(st.lists(st.lists(st.text(max_size=5), min_size=2, max_size=3), min_size=1, max_size=4))
@example([["a\rb", "\r"]])
def test_any_text_comes_back_from_csv(rows):
    """Also a carriage return, which ends a line for whoever reads it."""
    assert list(csv.reader(io.StringIO(csv_text(rows), newline=""))) == rows
