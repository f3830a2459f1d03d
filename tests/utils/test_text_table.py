"""Tables as text: by hand, and any text comes back from CSV."""

import csv
import io

from hypothesis import given
from hypothesis import strategies as st

from qs3.utils.text_table import aligned, csv_text, markdown

ROWS = [("class", "n"), ("a|b", "1000"), ("é", "5 %")]


def test_aligned_text_and_markdown():
    assert aligned(ROWS) == ["class  n", "-----  ----", "a|b    1000", "é      5 %"]
    assert aligned(ROWS, numbers=True, rule=False) == ["class     n", "a|b    1000", "é       5 %"]
    first, rule, second, _ = markdown(ROWS)
    assert (first, rule, second) == ("| class | n    |", "|-------|------|", r"| a\|b  | 1000 |")


cell = st.text(st.characters(exclude_characters="\r"), max_size=5)


@given(st.lists(st.lists(cell, min_size=2, max_size=3), min_size=1, max_size=4))
def test_any_text_comes_back_from_csv(rows):
    assert list(csv.reader(io.StringIO(csv_text(rows), newline=""))) == rows
    assert csv_text([["a", None, 0.1]]) == "a,,0.1\n"
