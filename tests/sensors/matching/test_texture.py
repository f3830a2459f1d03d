"""Texture that counts is what exceeds the camera's own noise."""

import numpy as np
import pytest

from qs3.sensors.matching import CensusMatcher
from qs3.sensors.matching.base import TextureOverNoise, for_picture, window_moments
from qs3.sensors.optics.infrared import GreyNoise, InfraredCamera
from qs3.sensors.optics.visibility import Reason

CAMERA = InfraredCamera(electrons_at_white=3000.0, read_noise_e=25.0)
ASKED = TextureOverNoise(0.7, CAMERA.noise(1.0))


def picture(level, texture, seed=0):
    """Grey values whose true standard deviation over pixels is `texture`."""
    rng = np.random.default_rng(seed)
    flat = level + texture * rng.choice([-1.0, 1.0], (120, 160))
    return CAMERA.expose(flat.astype(np.float32), 1.0, rng)


def noise(level):
    per_grey = CAMERA.electrons_at_white / 255
    return np.sqrt(level / per_grey + (CAMERA.read_noise_e / per_grey) ** 2)


@pytest.mark.parametrize("level", [12.0, 60.0, 200.0])
def test_noise_alone_is_no_texture_and_twice_the_noise_is(level):
    moments = window_moments(picture(level, 0.0), 9)
    assert ASKED.enough(*moments).mean() < 0.02
    moments = window_moments(picture(level, 2 * noise(level)), 9)
    assert ASKED.enough(*moments).mean() > 0.99


def test_a_dim_pair_with_dots_matches_and_a_bright_one_without_does_not():
    """A threshold of grey values does the opposite."""
    rng = np.random.default_rng(1)
    quiet = InfraredCamera(electrons_at_white=20_000.0, read_noise_e=5.0)
    asked = TextureOverNoise(0.7, quiet.noise(1.0))
    dots = (rng.random((60, 200)) < 0.1).astype(np.float32)
    dim = 6.0 + 5.0 * dots
    pair = [quiet.expose(np.roll(dim, -shift, axis=1), 1.0, rng) for shift in (0, 9)]
    bright = [CAMERA.expose(np.full((60, 200), 220.0, np.float32), 1.0, rng) for _ in range(2)]
    inner = (slice(10, -10), slice(40, -20))
    common = {"num_disparities": 24}
    by_noise = CensusMatcher(**common, min_texture=0.0, texture=asked)
    by_grey = CensusMatcher(**common, min_texture=2.0)
    found = by_noise.match(*pair).disparity[inner]
    assert np.mean(np.abs(found - 9) < 0.5) > 0.9
    assert np.isfinite(by_grey.match(*pair).disparity[inner]).mean() < 0.5
    asked_of_both = CensusMatcher(**common, min_texture=0.0, texture=ASKED)
    assert (asked_of_both.match(*bright).reason[inner] == Reason.DARK).mean() > 0.95


def test_an_amplified_picture_is_judged_by_its_own_noise():
    """A flat surface at a gain of 8: by the noise of an unamplified one 9 of 10 windows pass."""
    camera = InfraredCamera(read_noise_e=10.0, max_exposure=10.0, max_gain=16.0)
    flat = np.full((120, 160), 1.0, np.float32)
    image = camera.expose(flat, 80.0, np.random.default_rng(0))
    moments = window_moments(image, 9)
    matcher = CensusMatcher(texture=TextureOverNoise(0.7))
    plain, amplified = (for_picture(matcher, camera.noise(gain)).texture for gain in (10.0, 80.0))
    assert plain.enough(*moments).mean() > 0.9
    assert amplified.enough(*moments).mean() < 0.02
    assert amplified.noise == GreyNoise(camera.electrons_at_white / 8, 10.0)
