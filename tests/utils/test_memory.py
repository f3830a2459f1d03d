"""Texts of gigabytes are refused by their size, before they are read."""

from __future__ import annotations

import os

import pytest

from qs3.errors import DataError
from qs3.runs.folder import STARTED, read_started
from qs3.runs.metrics import METRICS, read_metrics
from qs3.runs.predictions import read_predictions
from qs3.runs.pseudo_labels import read_pseudo_labels
from qs3.utils.memory import read_whole
from tests.limits import memory_of_at_most

READERS = {
    STARTED: lambda path: read_started(path.parent),
    METRICS: lambda path: read_metrics(path.parent),
    "predictions.csv": read_predictions,
    "pseudo_labels.csv": read_pseudo_labels,
}


@pytest.mark.parametrize("name", READERS)
def test_a_large_text_is_refused_before_it_is_read(name, tmp_path):
    path = tmp_path / name
    path.touch()
    os.truncate(path, 4 << 30)  # a hole, which takes no disk
    with (
        memory_of_at_most(1 << 28),
        pytest.raises(DataError, match=f"{name} takes .* GB of memory"),
    ):
        READERS[name](path)


def test_the_peak_is_what_counts(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    monkeypatch.setenv("QS3_MEMORY_GB", "0.00001")  # 10,000 bytes
    assert read_whole(path, 10) == b"x" * 1000
    with pytest.raises(DataError, match=r"a takes 1\.1e-05 GB of memory"):
        read_whole(path, 11)
