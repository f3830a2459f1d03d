"""`predict_depth`: what it takes for a depth image, and what it says where nothing can be said."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import qs3
from qs3.errors import DataError
from qs3.inference.predictor import Predictor
from tests.inference.test_depth_command import SHOT, seen


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    return qs3.load("pointnet-speckle")


@pytest.fixture(scope="module")
def picture() -> tuple[np.ndarray, np.ndarray]:
    """Depth in metres, and the number of the thing that each pixel shows."""
    depth, mask = seen()
    return depth / 1000, mask


def test_what_a_masked_array_hides_was_not_measured(predictor, picture):
    """Whatever numbers lie below: here a wall in the middle of the things."""
    depth, mask = picture
    hidden = np.zeros(depth.shape, dtype=bool)
    hidden[:, ::3] = True
    expected = predictor.predict_depth(np.where(hidden, 0, depth), SHOT.camera, mask=mask)
    covered = np.ma.masked_array(np.where(hidden, 2.5, depth), mask=hidden)
    found = predictor.predict_depth(covered, SHOT.camera, mask=mask)
    assert len(found) == len(expected) == 2
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.points_m, other.points_m)
        np.testing.assert_array_equal(one.probabilities, other.probabilities)
    one_thing = np.ma.masked_array(mask, mask=mask == 1)  # the other is hidden
    assert [one.name for one in predictor.predict_depth(depth, SHOT.camera, mask=one_thing)] == [
        "[2]"
    ]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"camera": "525,525,319.5,239.5"}, "camera='525,525,.*expected fx, fy, cx, cy"),
        ({"camera": None}, "camera=None: expected fx"),
        ({"camera": {"fx": 525}}, "camera={'fx': 525}: expected fx"),
        ({"camera": [[1, 2], [3]]}, r"camera=\[\[1, 2\], \[3\]\]: expected fx"),
        ({"mask": None, "box": "1,2,30,40"}, "box='1,2,30,40': expected left, top"),
        ({"up": "z"}, "up='z': expected x, y, z"),
        ({"up": (0, 1)}, "is not a direction"),
    ],
)
def test_words_in_the_place_of_numbers(
    predictor: Predictor, picture: Any, given: dict[str, Any], message: str
) -> None:
    depth, mask = picture
    settings = {"camera": SHOT.camera, "mask": mask, **given}
    with pytest.raises(DataError, match=message):
        predictor.predict_depth(depth, **settings)


def test_numbers_may_be_arrays(predictor, picture):
    depth, mask = picture
    fx, fy, cx, cy = SHOT.camera
    first, second = (
        predictor.predict_depth(depth, camera, mask=mask, up=up)
        for camera, up in (
            (SHOT.camera, [0, -1, 0]),
            (np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([[0], [-2.0], [0]])),
        )
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.probabilities, other.probabilities)


def test_a_net_that_diverged_names_no_class(predictor, picture):
    depth, mask = picture
    net = copy.deepcopy(predictor.net)
    for parameter in net.parameters():
        parameter.requires_grad_(False).fill_(float("nan"))
    for one in replace(predictor, net=net).predict_depth(depth, SHOT.camera, mask=mask):
        assert one.cls == ""
        assert np.isnan(one.confidence)
        assert np.isnan(one.probabilities).all()
        assert "training has diverged" in one.cautions[-1]
        assert len(one.points_m)
