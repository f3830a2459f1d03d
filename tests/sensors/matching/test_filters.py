import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import Match
from qs3.sensors.matching.filters import Quantiser, SmallRegions, SpatialFilter
from qs3.sensors.optics.visibility import Reason

MAPS = arrays(
    np.float32,
    (7, 9),
    elements=st.one_of(st.just(np.nan), st.sampled_from([10.0, 10.25, 10.5, 14.0, 20.0])),
)


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
    depth, used, reason = SpeckleStereo(filters=(SmallRegions(2, 1.0),)).depth_of(match)
    np.testing.assert_allclose(depth[0, :3], 3.0, rtol=1e-6)
    assert np.isnan(depth[0, 3:]).all()
    assert np.isnan(used[0, 3:]).all()
    assert list(reason[0]) == [0, 0, 0, *[Reason.FILTERED] * 2, Reason.DARK, Reason.FILTERED]
    _, _, reason = SpeckleStereo().depth_of(match)
    assert list(reason[0]) == [0, 0, 0, Reason.RANGE, Reason.RANGE, Reason.DARK, 0]
