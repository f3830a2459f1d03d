from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import DataError
from qs3.runs.predictions import Predictions, read_predictions, write_predictions


def predictions(labels) -> Predictions:
    p = np.array([[0.1, 0.7, 0.2], [1 / 3, 1 / 3, 1 / 3]])
    return Predictions(("a", "b", "c, d"), ("x/1", 'y"2'), ("mesh", 'y"2'), np.array(labels), p)


@pytest.mark.parametrize("labels", [[2, 0], [-1, -1]])
def test_read_as_written(tmp_path, labels):
    before = predictions(labels)
    write_predictions(tmp_path / "p.csv", before)
    after = read_predictions(tmp_path / "p.csv")
    assert (after.classes, after.ids, after.meshes) == (before.classes, before.ids, before.meshes)
    np.testing.assert_array_equal(after.labels, labels)
    np.testing.assert_array_equal(after.probabilities, before.probabilities)  # every digit
    np.testing.assert_array_equal(after.predicted, [1, 0])


def test_tiers_are_a_column_where_there_are_some(tmp_path):
    plain, path = predictions([2, 0]), tmp_path / "p.csv"
    write_predictions(path, plain)
    assert "tier" not in path.read_text()
    assert read_predictions(path).tiers == ()
    write_predictions(path, replace(plain, tiers=("clean", "hard")))
    after = read_predictions(path)
    assert (after.classes, after.tiers) == (plain.classes, ("clean", "hard"))
    np.testing.assert_array_equal(after.probabilities, plain.probabilities)
    hard = after.of(np.array([False, True]))
    assert (hard.ids, hard.meshes, hard.tiers) == (plain.ids[1:], plain.meshes[1:], ("hard",))
    np.testing.assert_array_equal(hard.labels, [0])
    np.testing.assert_array_equal(hard.probabilities, plain.probabilities[1:])


HEADER = "id,mesh,label,predicted,p_a\n"
TWO = "id,mesh,label,predicted,p_a,p_b\n"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "id,mesh\n",
        HEADER,
        HEADER + "1,2,q,a,1\n",
        HEADER + "1\n",
        HEADER + "x" * 200_000,
        HEADER.replace("p_a", "tier,p_a") + "1,2,a,a\n",
        HEADER.replace("p_a", "tier") + "1,2,,a,b\n",
        HEADER + "1,2,a,a,1,0\n",
        HEADER + "1,2,a,a,1\n1,2,a,a,1\n",
        HEADER + "1,2,a,a,7\n",
        HEADER + "1,2,a,a,-0.1\n",
        TWO + "1,2,a,a,1\n",
        TWO + "1,2,a,b,1,0\n",
        TWO + "1,2,a,a,nan,1\n",
        TWO.replace("p_b", "p_a") + "1,2,a,a,1,0\n",
    ],
)
def test_damage_is_an_error_that_names_the_file(tmp_path, text):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=r"p\.csv cannot be read"):
        read_predictions(path)


def test_a_net_that_diverged_has_rows_of_nan(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text(TWO + "1,2,a,a,nan,nan\n")
    assert np.isnan(read_predictions(path).probabilities).all()


def test_a_missing_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(DataError, match=r"p\.csv cannot be read"):
        read_predictions(tmp_path / "p.csv")
