"""What is said of the two intervals of balanced accuracy (docs/explanation/decisions.md) is so."""

from tests.report.balanced_coverage import DESIGNS, coverage


def test_compare_keeps_its_level_and_judge_is_narrower():
    """Of 400 intervals of few rooms; the standard error of a share of 95 % is 1 %."""
    (compare, judge, _), (wide, narrow, _) = coverage(DESIGNS[1], seeds=5)
    assert 0.92 <= compare <= 0.985
    assert 0.84 <= judge < compare
    assert narrow < wide
