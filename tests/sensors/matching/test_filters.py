import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qs3.sensors.matching import Match
from qs3.sensors.matching.filters import (
    FillHoles,
    Median,
    NeighbourCheck,
    Quantiser,
    SmallRegions,
    SpatialFilter,
)
from qs3.sensors.matching.triangulation import Triangulation
from qs3.sensors.optics.visibility import Reason

MAPS = arrays(
    np.float32,
    (7, 9),
    elements=st.one_of(st.just(np.nan), st.sampled_from([10.0, 10.25, 10.5, 14.0, 20.0])),
)


def window(image, row, col, half):
    part = image[max(0, row - half) : row + half + 1, max(0, col - half) : col + half + 1]
    return part[np.isfinite(part)]


@given(MAPS)
@settings(max_examples=60, deadline=None)
def test_median_equals_the_median_of_the_valid_neighbours(image):
    out = Median(3).apply(image)
    np.testing.assert_array_equal(np.isfinite(out), np.isfinite(image))
    for row, col in np.argwhere(np.isfinite(image)):
        assert out[row, col] == pytest.approx(np.median(window(image, row, col, 1)))


@given(MAPS)
@settings(max_examples=60, deadline=None)
def test_neighbour_check_counts_who_agrees(image):
    check = NeighbourCheck(3, max_step_px=0.3, min_share=0.375)
    out = check.apply(image)
    for row in range(7):
        for col in range(9):
            value = image[row, col]
            agree = int((np.abs(window(image, row, col, 1) - value) <= 0.3).sum()) - 1
            kept = np.isfinite(value) and agree >= 3  # of 8
            assert np.isfinite(out[row, col]) == kept
            assert not kept or out[row, col] == value


def smoothed(image, alpha, step, iterations):
    """Value by value, forwards and backwards along rows, then along columns."""
    out = image.astype(float)
    for _ in range(iterations):
        for turned in (False, True):
            lines = out.T if turned else out
            for line in lines:
                for order in (range(1, len(line)), range(len(line) - 2, -1, -1)):
                    for i in order:
                        before = line[i - 1 if order.step > 0 else i + 1]
                        if abs(line[i] - before) <= step:  # not for NaN
                            line[i] = alpha * line[i] + (1 - alpha) * before
    return out


@given(MAPS, st.sampled_from([0.2, 0.5, 1.0]), st.sampled_from([0.3, 5.0]), st.integers(1, 2))
@settings(max_examples=60, deadline=None)
def test_the_spatial_filter_equals_a_loop_over_pixels(image, alpha, step, iterations):
    kept = image.copy()
    out = SpatialFilter(alpha, step, iterations).apply(image)
    np.testing.assert_allclose(out, smoothed(image, alpha, step, iterations), rtol=1e-5)
    np.testing.assert_array_equal(image, kept)
    if alpha == 1:
        np.testing.assert_array_equal(out, image)


def test_the_spatial_filter_smooths_noise_and_keeps_steps():
    rng = np.random.default_rng(0)
    flat = np.where(np.arange(80) < 40, 10.0, 20.0) + rng.normal(0, 0.1, (80, 80))
    out = SpatialFilter(0.4).apply(flat.astype(np.float32))
    assert out[:, :40].std() < 0.4 * flat[:, :40].std()
    assert out[:, :40].max() < 11
    assert out[:, 40:].min() > 19


def test_the_spatial_filter_makes_flying_pixels_of_low_steps():
    low = np.where(np.arange(40) < 20, 10.0, 10.8).astype(np.float32)[None].repeat(9, 0)
    out = SpatialFilter(0.4, max_step_px=1.0).apply(low)
    between = (out > 10.2) & (out < 10.6)
    assert between.any(axis=1).all()
    kept = SpatialFilter(0.4, max_step_px=0.5).apply(low)
    np.testing.assert_allclose(kept, low, atol=1e-5)


def regions(image, step):
    """Sizes of connected regions by flood fill."""
    size = np.zeros(image.shape, int)
    seen = ~np.isfinite(image)
    for start in np.argwhere(~seen):
        if seen[tuple(start)]:
            continue
        stack, region = [tuple(start)], []
        seen[tuple(start)] = True
        while stack:
            row, col = stack.pop()
            region.append((row, col))
            for r, c in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
                inside = 0 <= r < image.shape[0] and 0 <= c < image.shape[1]
                if inside and not seen[r, c] and abs(image[r, c] - image[row, col]) <= step:
                    seen[r, c] = True
                    stack.append((r, c))
        for place in region:
            size[place] = len(region)
    return size


@given(MAPS)
@settings(max_examples=60, deadline=None)
def test_small_regions_equal_a_flood_fill(image):
    out = SmallRegions(max_size_px=4, max_step_px=0.5).apply(image)
    kept = regions(image, 0.5) > 4
    np.testing.assert_array_equal(np.isfinite(out), kept)
    np.testing.assert_array_equal(out[kept], image[kept])


@given(MAPS)
@settings(max_examples=60, deadline=None)
def test_holes_are_filled_from_the_farther_side_and_nothing_else_changes(image):
    out = FillHoles(2).apply(image)
    valid = np.isfinite(image)
    np.testing.assert_array_equal(out[valid], image[valid])
    for row in range(7):
        for col in np.flatnonzero(~valid[row]):
            left = [c for c in range(col) if valid[row, c]]
            right = [c for c in range(col, 9) if valid[row, c]]
            if left and right and right[0] - left[-1] - 1 <= 2:
                assert out[row, col] == min(image[row, left[-1]], image[row, right[0]])
            else:
                assert np.isnan(out[row, col])


@given(MAPS, st.sampled_from([1, 8, 16, 32]))
def test_the_quantiser_rounds_to_its_steps(image, steps):
    out = Quantiser(steps).apply(image + np.float32(0.013))
    valid = np.isfinite(image)
    np.testing.assert_array_equal(np.isfinite(out), valid)
    np.testing.assert_array_equal(out[valid] * steps, np.rint(out[valid] * steps))
    assert np.all(np.abs(out - image - np.float32(0.013))[valid] <= 0.5 / steps + 1e-5)


def test_triangulation_says_what_it_dropped():
    disparity = np.array([[50, 50, 50, 200, 10, np.nan, 50]], dtype=np.float32)
    match = Match.of(disparity, Reason.DARK)
    geometry = Triangulation(1500.0, 0.1, 0.0, 1.0, 6.0)
    depth, used, reason = geometry.depth(match, Quantiser(), [SmallRegions(2, 1.0)])
    np.testing.assert_allclose(depth[0, :3], 3.0, rtol=1e-6)
    assert np.isnan(depth[0, 3:]).all()
    assert np.isnan(used[0, 3:]).all()
    assert list(reason[0]) == [0, 0, 0, *[Reason.FILTERED] * 2, Reason.DARK, Reason.FILTERED]
    depth, _, reason = geometry.depth(match, Quantiser(), [])
    assert list(reason[0]) == [0, 0, 0, Reason.RANGE, Reason.RANGE, Reason.DARK, 0]
