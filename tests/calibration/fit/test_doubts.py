"""Frames held against the model: bins, patches, and which frame is named. Whole fits: test_fit."""

import numpy as np
import pytest

from qs3.calibration.fit.doubts import check_walls
from qs3.calibration.fit.noise import Noise
from qs3.calibration.fit.planes import Wall
from qs3.calibration.fit.rounded import PATCH_PX, share_together
from qs3.calibration.fit.steps import Steps
from qs3.errors import DataError

NO_STEPS = Steps(0.0, np.zeros(0))
SHAPE = (5 * PATCH_PX, 6 * PATCH_PX)
PLANE = np.full(SHAPE, 2.0)


def wall(name, error_m):
    region = np.ones(SHAPE, dtype=bool)
    return Wall(name, PLANE + error_m, PLANE, 0 * PLANE, region, 2.0, 0.0, 0.0)


def checked(sigma_mm, together=(0.1, 0.1, 0.1)):
    """Three frames with two bins each, at 1 and 2 m; the law says 1 mm (Z / m)^2."""
    noise = Noise(
        0.0, 0.001, 2.0, np.array([1.0, 2.0] * 3), np.array(sigma_mm) / 1000,
        np.repeat([0, 1, 2], 2), together, True, 0.0,
    )  # fmt: skip
    walls = [wall(name, 0 * PLANE) for name in ("a.png", "b.png", "c.png")]
    return check_walls(walls, noise, NO_STEPS)


def test_noise_of_the_law_is_a_camera_s():
    assert checked([1.0, 4.0, 1.5, 5.0, 1.0, 2.0]) == []


@pytest.mark.parametrize(
    ("sigma", "said"),
    [
        # twice the law in the middle of its bins
        (
            [1, 4, 2.3, 9.2, 1, 4],
            "b.png: 2.3 to 9.2 mm .* at 1.00 m the law of all frames says 1.0",
        ),
        # three times in one
        ([1, 4, 1, 4, 1, 12.5], "c.png: 1.0 to 12.5 mm .* at 2.00 m .* 4.0 mm, where it has 12.5"),
    ],
)
def test_a_frame_far_from_the_law_is_refused_and_the_others_are_not_named(sigma, said):
    with pytest.raises(DataError, match=said) as error:
        checked(sigma)
    assert str(error.value).count(".png") == 1


def test_patches_are_doubted_where_errors_are_small_and_refused_where_they_are_large():
    (doubt,) = checked([1, 4, 1, 4, 1, 4], together=(0.1, 0.6, 0.1))
    assert doubt.startswith("b.png: 60 % of the errors' variance")
    # The law of kitchens alone fits them.
    one = np.ones(1)
    noise = Noise(0.0, 0.015, 1.0, one, 0.015 * one, np.array([0]), (0.6,), True, 0.0)
    with pytest.raises(DataError, match=r"a\.png: errors of 1\.5 % of the distance; 60 %"):
        check_walls([wall("a.png", 0 * PLANE)], noise, NO_STEPS)


def test_share_of_patches_is_that_of_a_sum_of_patches_and_noise():
    rng = np.random.default_rng(0)
    fine = rng.normal(0, 0.001, SHAPE)
    coarse = np.kron(rng.normal(0, 1, (5, 6)), np.ones((PATCH_PX, PATCH_PX)))
    coarse *= 0.001 / coarse.std()
    flat = 1 / PLANE
    found = [share_together(wall("w", e), flat, NO_STEPS) for e in (fine, coarse, fine + coarse)]
    assert found == pytest.approx([1 / PATCH_PX**2, 1.0, 0.5], abs=0.02)


def test_rounding_alone_is_no_error_of_patches():
    """A wall a little closer than a level of a coarse step is seen at that level everywhere."""
    steps = Steps(0.1, np.array([1.9, 2.0, 2.1]))
    slanted = np.broadcast_to(1 / np.linspace(1.96, 2.04, SHAPE[1]), SHAPE)
    assert share_together(wall("w", 0 * PLANE), slanted, steps) == 0
