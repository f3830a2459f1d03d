"""Predictions and pseudo-labels are read as they were written; damage is an error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import DataError
from qs3.runs.predictions import (
    Predictions,
    read_predictions,
    read_pseudo_labels,
    write_predictions,
    write_pseudo_labels,
)


def predictions(labels) -> Predictions:
    p = np.array([[0.1, 0.7, 0.2], [1 / 3, 1 / 3, 1 / 3]])
    return Predictions(("a", "b", "c, d"), ("x/1", 'y"2'), ("mesh", 'y"2'), np.array(labels), p)


@pytest.mark.parametrize("tiers", [(), ("clean", "hard")])
@pytest.mark.parametrize("labels", [[2, 0], [-1, -1]])
def test_read_as_written(tmp_path, labels, tiers):
    before = replace(predictions(labels), tiers=tiers)
    write_predictions(tmp_path / "p.csv", before)
    after = read_predictions(tmp_path / "p.csv")
    for name in ("classes", "ids", "meshes", "tiers"):
        assert getattr(after, name) == getattr(before, name)
    np.testing.assert_array_equal(after.labels, labels)
    np.testing.assert_array_equal(after.probabilities, before.probabilities)  # every digit
    np.testing.assert_array_equal(after.predicted, [1, 0])


def test_pseudo_labels_are_read_as_written(tmp_path):
    confidence = np.array([1 / 3, 0.75])
    path = tmp_path / "round" / "p.csv"
    write_pseudo_labels(path, ["x", "y,z"], np.array([1, 0]), confidence, np.array([1, 0]), "ab")
    found = read_pseudo_labels(path).to_numpy().tolist()
    assert found == [["x", "b", 1 / 3, True], ["y,z", "a", 0.75, False]]


HEADER = "id,mesh,label,predicted,p_a,p_b\n"


@pytest.mark.parametrize(
    "text",
    [
        "", HEADER, HEADER + "1,2,a,a,1\n", HEADER + "1,2,q,a,1,0\n", HEADER + "1,2,a,b,1,0\n",
        HEADER + "1,2,a,a,1,x\n", HEADER + "1,2,a,a,1,0\n1,2,a,a,1,0\n", HEADER + '"1,2',
    ],
)  # fmt: skip
def test_damage_is_an_error_that_names_the_file(tmp_path, text):
    path = tmp_path / "p.csv"
    path.write_text(text)
    for read in (read_predictions, read_pseudo_labels):
        with pytest.raises(DataError, match=r"p\.csv"):
            read(path)
