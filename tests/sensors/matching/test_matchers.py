"""What every matcher must do, on textures with known disparities."""

import numpy as np
import pytest

from qs3.sensors.matching import CensusMatcher, ReferenceMatcher, StereoBlockMatcher
from qs3.sensors.matching.base import found_px
from qs3.sensors.optics.visibility import Reason
from tests.sensors.matching.textures import dots, seen

MATCHERS = {
    "block": StereoBlockMatcher(64, 19),
    "correlation": ReferenceMatcher(9, 0, 64, 0),
    "census": CensusMatcher(64),
}
# Error of the median in one sub-pixel phase, rms of a pixel, mean of the medians over all phases.
BARS = {
    "block": (0.05, 0.06, 0.01),
    "correlation": (0.04, 0.06, 0.005),
    "census": (0.02, 0.06, 0.005),
}


@pytest.mark.parametrize("name", BARS)
def test_all_sub_pixel_phases_come_back(name):
    single, spread, pooled = BARS[name]
    medians = []
    for phase in range(0, 16, 1 if name == "block" else 2):  # which rounds to sixteenths
        texture, true = dots(80, 300, phase), 20 + phase / 16
        image, other = seen(texture, true, seed=phase), seen(texture, 0, seed=100 + phase)
        found = MATCHERS[name].match(image, other)
        error = (found.disparity - true)[12:-12, 90:-20]
        assert np.isfinite(error).mean() > 0.97
        good = error[np.abs(error) < 1]
        assert len(good) > 0.97 * error.size
        assert abs(np.median(good)) < single
        assert good.std() < spread
        medians.append(np.median(good))
    assert abs(np.mean(medians)) < pooled


@pytest.mark.parametrize("name", MATCHERS)
def test_a_search_finds_to_half_a_pixel_within_its_ends(name):
    make = {
        "block": StereoBlockMatcher(32, 19, min_disparity=8),
        "correlation": ReferenceMatcher(9, 8, 32, 0),
        "census": CensusMatcher(32, 8),
    }
    matcher, texture = make[name], dots(80, 300, 4)
    least, most = found_px(matcher)
    assert (least, most) == (8.5, 38.5)

    def right(true):
        """Share of the pixels that come back within 0.15 px."""
        image, other = seen(texture, true, seed=1), seen(texture, 0, seed=2)
        error = (matcher.match(image, other).disparity - true)[12:-12, 90:-20]
        return (np.abs(error) < 0.15).mean()

    assert min(right(least + 0.4), right(most - 0.4)) > 0.85
    assert max(right(least - 0.25), right(most + 0.25)) < 0.25


@pytest.mark.parametrize("name", MATCHERS)
def test_an_image_without_texture_matches_nowhere(name):
    flat = np.full((40, 160), 90, np.uint8)
    found = MATCHERS[name].match(flat, flat)
    assert np.isnan(found.disparity).all()
    assert (found.reason != Reason.OK).all()


@pytest.mark.parametrize("name", MATCHERS)
def test_a_part_of_the_image_matches_as_the_whole_does(name):
    texture = dots(80, 300, 5)
    image, other = seen(texture, 17.3, seed=1), seen(texture, 0, seed=2)
    whole = MATCHERS[name].match(image, other).disparity
    part = MATCHERS[name].match(image[:, 100:220], other, first=100).disparity
    inner = (slice(12, -12), slice(24, -24))
    a, b = whole[:, 100:220][inner], part[inner]
    both = np.isfinite(a) & np.isfinite(b)
    assert both.mean() > 0.95
    # Semi-global paths start elsewhere; most pixels do not notice.
    assert (np.abs(a - b)[both] < 0.07).mean() > 0.97


@pytest.mark.parametrize(
    "matcher",
    [
        ReferenceMatcher(min_disparity=-32, steps_per_px=0),
        CensusMatcher(64, min_disparity=-32),
        StereoBlockMatcher(64, 19, min_disparity=-32),
    ],
)
def test_negative_disparities_for_a_stored_reference(matcher):
    texture = dots(60, 300, 7)
    reference = seen(texture, 0).astype(np.float32)
    for true in (-14.0, 9.0):
        image = seen(texture, true, seed=3)[:, 90:210]
        found = matcher.match(image, reference, first=90).disparity[12:-12, 12:-12]
        assert np.isfinite(found).mean() > 0.9
        assert np.nanmedian(found) == pytest.approx(true, abs=0.07)


@pytest.mark.parametrize("make", [StereoBlockMatcher, CensusMatcher])
def test_the_left_right_check_drops_what_the_other_camera_does_not_see(make):
    """A near bar hides a strip of the background from the right camera."""
    back, front = dots(60, 300, 8), dots(60, 300, 9)
    image, other = seen(back, 10, seed=1), seen(back, 0, seed=2)
    near = seen(front, 30, seed=3), seen(front, 0, seed=4)
    image[:, 150:210], other[:, 120:180] = near[0][:, 150:210], near[1][:, 120:180]
    # Background columns whose partner u - 10 lies in 120..180 of the right image are hidden;
    # of these 130..150 are not covered by the bar in the left image.
    hidden = (slice(12, -12), slice(133, 147))
    off, on = (
        make(64, max_difference_px=limit).match(image, other).disparity[hidden] for limit in (-1, 1)
    )
    assert np.isfinite(on).mean() < 0.5
    assert np.isfinite(on).mean() <= np.isfinite(off).mean()


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
