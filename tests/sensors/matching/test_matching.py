import numpy as np
import pytest

from qs3.sensors.matching import (
    ReferenceMatcher,
    SemiGlobalMatcher,
    StereoBlockMatcher,
)
from qs3.sensors.optics.visibility import Reason
from tests.sensors.matching.textures import dots, seen


def test_scores_equal_a_brute_force_correlation():
    rng = np.random.default_rng(5)
    reference = (rng.random((30, 60)) * 255).astype(np.float32)
    image = (rng.random((30, 40)) * 255).astype(np.uint8)
    matcher = ReferenceMatcher(window_px=5, min_disparity=-4, num_disparities=9)
    scores = matcher._scores(image, reference, first=10)
    grey = image.astype(float)
    for k, row, col in [(0, 15, 20), (4, 10, 9), (8, 20, 31)]:
        window = grey[row - 2 : row + 3, col - 2 : col + 3]
        u = 10 + col - (-4 + k)
        other = reference[row - 2 : row + 3, u - 2 : u + 3].astype(float)
        covariance = (window * other).mean() - window.mean() * other.mean()
        expected = covariance / (window.std() * other.std())
        assert scores[k, row, col] == pytest.approx(expected, abs=1e-3)


def test_sgbm_rounds_towards_zero_and_is_repaired():
    """What StereoSGBM makes of every sub-pixel, by its formula, comes back without bias."""
    true = 20 + (np.arange(4096) + 0.5) / 4096 - 0.5
    whole = np.rint(true)
    raw = whole + np.trunc((true - whole) * 16 + 0.5) / 16
    assert np.mean(raw - true) == pytest.approx(1 / 32, abs=0.003)
    repaired = SemiGlobalMatcher(64, a_factor=0.0)._repaired(raw.astype(np.float32))
    error = repaired - true
    assert abs(error.mean()) < 1e-3
    assert np.abs(error).max() < 1 / 16 + 1e-3  # around a whole pixel two steps fall together
    inner = np.abs(true - whole) > 1.6 / 16
    assert np.abs(error[inner]).max() < 1 / 32 + 1e-3


def test_block_matching_tells_dark_from_not_found():
    texture = dots(60, 300, seed=12)
    image, other = (seen(texture, d) for d in (20.0, 0.0))
    image[:, 120:180] = 3
    image[:, 200:240] = seen(dots(60, 300, seed=13), 0.0)[:, 200:240]
    found = StereoBlockMatcher(64, 9).match(image, other)
    assert (found.reason[8:-8, 130:170] == Reason.DARK).all()
    foreign = found.reason[8:-8, 208:232]
    assert (foreign == Reason.UNMATCHED).mean() > 0.5
    assert (foreign != Reason.DARK).all()
