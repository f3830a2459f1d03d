import cv2
import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.sensors.matching import STEREOBM_BIAS_PX, ReferenceMatcher, StereoBlockMatcher


def dots(height, width, seed, scale=8):
    """A smooth random texture that can be shifted by fractions of a pixel: [h, w * scale]."""
    rng = np.random.default_rng(seed)
    fine = rng.random((height, width)).astype(np.float32)
    fine = cv2.resize(fine, (width * scale, height), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(fine, (0, 0), sigmaX=scale, sigmaY=1)  # the lens: one pixel
    fine = (fine - fine.min()) / (fine.max() - fine.min())
    return fine * 255


def shifted(texture, shift_px, scale=8):
    """The texture sampled at whole pixels after moving it to the right by shift_px."""
    offset = round(shift_px * scale)
    return np.roll(texture, offset, axis=1)[:, scale // 2 :: scale]


@pytest.mark.parametrize("true", [20.0, 20.25, 20.5, 20.75, 33.125])
def test_block_matching_finds_a_known_disparity_without_bias(true):
    texture = dots(120, 400, seed=1)
    left = shifted(texture, true).astype(np.uint8)
    right = shifted(texture, 0.0).astype(np.uint8)
    found = StereoBlockMatcher(64, 19).match(left, right).disparity[20:-20, 120:-40]
    assert np.isfinite(found).mean() > 0.95
    assert np.nanmedian(found) == pytest.approx(true, abs=0.06)


def test_removing_the_bias_of_stereobm_is_a_switch():
    texture = dots(60, 300, seed=2)
    left, right = (shifted(texture, d).astype(np.uint8) for d in (12.0, 0.0))
    with_bias = StereoBlockMatcher(32, 11, remove_bias=False).match(left, right).disparity
    without = StereoBlockMatcher(32, 11).match(left, right).disparity
    both = np.isfinite(with_bias)
    np.testing.assert_allclose((with_bias - without)[both], STEREOBM_BIAS_PX, atol=1e-5)


def test_a_dark_image_matches_nowhere():
    dark = np.zeros((60, 200), np.uint8)
    assert np.isnan(StereoBlockMatcher(32, 11).match(dark, dark).disparity).all()
    reference = np.random.default_rng(0).random((60, 200)).astype(np.float32) * 255
    assert np.isnan(ReferenceMatcher().match(dark, reference).disparity).all()


@pytest.mark.parametrize("true", [-7.5, 0.0, 4.25, 11.625])
def test_reference_matching_finds_a_known_disparity_at_its_steps(true):
    texture = dots(80, 400, seed=3)
    reference = shifted(texture, 0.0).astype(np.float32)
    image = shifted(texture, true).astype(np.uint8)
    part, left = image[:, 100:260], 100
    found = ReferenceMatcher().match(part, reference, left).disparity[8:-8, 8:-8]
    assert np.isfinite(found).mean() > 0.95
    assert np.nanmedian(found) == pytest.approx(true, abs=0.125)
    steps = found[np.isfinite(found)] * 8
    np.testing.assert_array_equal(steps, np.rint(steps))


def test_reference_matching_ignores_gain_and_offset():
    texture = dots(60, 300, seed=4)
    reference = shifted(texture, 0.0).astype(np.float32)
    image = shifted(texture, 3.0)
    matcher = ReferenceMatcher(steps_per_px=0)
    plain = matcher.match(image.astype(np.uint8), reference).disparity
    dim = matcher.match((image * 0.4 + 30).astype(np.uint8), reference).disparity
    both = np.isfinite(plain) & np.isfinite(dim)
    assert both[8:-8, 20:-20].mean() > 0.9
    # Rounding to whole grey values moves a match a little, and a few to another dot.
    assert np.quantile(np.abs(plain - dim)[both], 0.98) < 0.1


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


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: StereoBlockMatcher(num_disparities=50), "num_disparities"),
        (lambda: StereoBlockMatcher(block_size=10), "block_size"),
        (lambda: ReferenceMatcher(window_px=4), "window_px"),
        (lambda: ReferenceMatcher(num_disparities=2), "num_disparities"),
    ],
)
def test_settings_out_of_range_are_refused(make, key):
    with pytest.raises(ConfigError, match=key):
        make()
