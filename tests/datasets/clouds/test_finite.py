"""Clouds that lie far from their origin, as those of maps do."""

import numpy as np
import pytest

from qs3.datasets.clouds.finite import checked
from qs3.errors import DataError

CLOUD = np.random.default_rng(0).uniform(-0.5, 0.5, size=(2000, 3))
UTM = np.array([500_123.25, 5_400_321.75, 441.5])


def test_a_map_s_coordinates_keep_their_digits():
    found = checked(CLOUD + UTM, "a")
    assert found.dtype == np.float32
    near = CLOUD - (CLOUD.min(axis=0) + CLOUD.max(axis=0)) / 2
    np.testing.assert_allclose(found[:, :2], near[:, :2], atol=1e-6)
    np.testing.assert_allclose(found[:, 2], CLOUD[:, 2] + 441.5, atol=4e-5)  # heights stay


def test_what_float32_can_hold_is_only_cast():
    for cloud in (CLOUD, 1000 * CLOUD, CLOUD + np.array([900, -900, 900]), CLOUD[:1] + UTM):
        assert np.array_equal(checked(cloud, "a"), cloud.astype(np.float32))


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (
            (CLOUD + UTM).astype(np.float32),
            "a: y is up to 5400322, where float32 has steps of 0.5.*in float64, or subtract",
        ),
        (CLOUD + UTM[::-1], r"z is up to 500123.*steps of 0.031, and the cloud is only 1 large"),
    ],
)
def test_lost_digits_and_lost_heights_are_named(cloud, message):
    with pytest.raises(DataError, match=message):
        checked(cloud, "a")


@pytest.mark.parametrize("value", [3.4e38, -1e20])  # the largest float32 is some cameras' nothing
def test_numbers_whose_squares_overflow_are_named(value):
    cloud = CLOUD.copy()
    cloud[7, 1] = value
    with pytest.raises(DataError, match=r"a, point 8: .* too far away for distances in float32"):
        checked(cloud, "a")
    with np.errstate(over="raise"):
        large = checked(1e18 * CLOUD.astype(np.float32), "a")
        assert np.isfinite(np.square(large - large[0]).sum(axis=1)).all()
