"""Points for which a camera wrote that it saw nothing."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from qs3.datasets.with_depth import with_depth
from qs3.errors import DataError
from tests.datasets.importers.own_clouds import own, write
from tests.running import main

CLOUD = np.array([[0, 2, 1], [0, 0, 2], [1, 2, 0], [0, 2, 0]], np.float64)
ZERO = np.zeros((3, 3))


def test_points_without_depth_go_and_are_counted():
    rows = np.vstack([ZERO[:2], CLOUD, [[np.nan, 0, 0]], -ZERO[:1]])
    seen, dropped = with_depth(rows, "a.npy")
    np.testing.assert_array_equal(seen, CLOUD)
    assert dropped == 4
    whole = (1000 * np.vstack([CLOUD, ZERO])).astype(np.int16)  # as Azure Kinect's library has them
    seen, dropped = with_depth(whole, "a.npy")
    np.testing.assert_array_equal(seen, 1000 * CLOUD)
    assert dropped == 3


def test_a_single_point_in_the_origin_is_a_shapes_own():
    rows = np.vstack([CLOUD, ZERO[:1]])
    seen, dropped = with_depth(rows, "a.npy")
    assert len(seen) == 5
    assert dropped == 0
    assert len(with_depth(ZERO[:1], "a.npy")[0]) == 1


def test_nothing_but_such_points_is_an_error():
    with pytest.raises(DataError, match=r"a.npy: all 4 points are NaN, infinite or \(0, 0, 0\)"):
        with_depth(np.vstack([ZERO, [[np.inf, 0, 0]]]), "a.npy")


def test_own_clouds_are_stored_and_shown_without_them(tmp_path, caplog, capsys):
    write(tmp_path / "in/bed/train/a.xyz", np.vstack([CLOUD[:3], ZERO]))
    with caplog.at_level(logging.INFO):
        points = own(tmp_path).open().points[0]
    assert "3 points that are NaN, infinite or (0, 0, 0) left out" in caplog.text
    assert {tuple(p) for p in points.tolist()} == {tuple(p) for p in CLOUD[:3].tolist()}
    assert main(["view", str(tmp_path / "in"), f"out={tmp_path / 'v.html'}"]) == 0
    assert "3 points without depth left out" in (tmp_path / "v.html").read_text()
