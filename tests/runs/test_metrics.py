"""The schema of `metrics.json`: what is written is read, and nothing else is taken for a result."""

from __future__ import annotations

from dataclasses import replace

import pytest

from qs3.errors import DataError
from qs3.runs.metrics import METRICS, Evaluated, read_metrics, write_metrics
from tests.report.made_runs import metrics, scores

TIERS = Evaluated(split="test", labels=True, norms="adabn", tiers={"hard": scores(0.25)})


@pytest.mark.parametrize("made", [metrics(), metrics(accuracy=None), metrics(evaluation=TIERS)])
def test_what_is_written_is_read(made, tmp_path):
    assert read_metrics(tmp_path) is None
    write_metrics(tmp_path, made)
    first = (tmp_path / METRICS).read_bytes()
    assert read_metrics(tmp_path) == made
    write_metrics(tmp_path, read_metrics(tmp_path))
    assert (tmp_path / METRICS).read_bytes() == first


def test_a_real_run_is_read_and_written_alike(finished, tmp_path):
    write_metrics(tmp_path, read_metrics(finished))
    assert (tmp_path / METRICS).read_bytes() == (finished / METRICS).read_bytes()
    assert len(read_metrics(tmp_path).rounds) == 2


def test_two_domains_of_one_name_are_two():
    """Own clouds of two folders, which have one name."""
    own = replace(metrics(), source="own", target="own")
    made = replace(own.made_of, source=replace(own.made_of.source, objects="others"))
    assert [*replace(own, made_of=made).domains] == ["own (source)", "own (target)"]
    taught = replace(own, method="supervised", made_of=made)
    assert taught.seen["source"] == taught.data.target
    assert [*taught.domains] == ["own"]


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('"seed": 0', '"seed": "0"', "seed"),
        ('"seed": 0', '"seed": 0, "speed": 1', "speed"),
        ('"finished"', '"failed"', "status"),
        ('"accuracy": 0.5', '"accuracy": NaN', "final"),
        ('"data"', '"dat', METRICS),
    ],
)
def test_a_damaged_file_is_named(old, new, place, tmp_path):
    write_metrics(tmp_path, metrics())
    text = (tmp_path / METRICS).read_text()
    assert old in text
    (tmp_path / METRICS).write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=METRICS) as error:
        read_metrics(tmp_path)
    assert place in str(error.value)
