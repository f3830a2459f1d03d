import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.sensors.optics.patterns import ReleasedSlide, Speckle


def test_the_default_slide_has_the_size_and_fill_of_the_released_one():
    slide = Speckle().slide
    assert slide.shape == (990, 1266)
    assert slide.dtype == np.float32
    assert set(np.unique(slide)) == {0.0, 1.0}
    assert slide.mean() == pytest.approx(0.111, abs=1e-3)


@settings(max_examples=15, deadline=None)
@given(
    columns=st.integers(8, 40),
    rows=st.integers(8, 40),
    spacing=st.integers(0, 2),
    seed=st.integers(0, 9),
)
def test_dots_keep_their_distance_across_the_seams_of_tiles(columns, rows, spacing, seed):
    fill = 0.25 / (1 + spacing) ** 2  # so few find room in every tile
    tile = Speckle(columns, rows, 1, 1, fill, spacing, seed).slide > 0
    assert tile.sum() == round(fill * rows * columns)
    for dy in range(-spacing, spacing + 1):
        for dx in range(-spacing, spacing + 1):
            if (dy, dx) != (0, 0):
                assert not (tile & np.roll(tile, (dy, dx), axis=(0, 1))).any()


def test_the_slide_is_square_and_its_dots_are_higher_than_wide():
    one = ReleasedSlide(columns=20, rows=10, tiles=1, dot_px=2, fill=0.005, spacing=4, detail=8)
    slide = one.slide
    assert slide.shape == (320, 320)
    assert slide.dtype == np.float32
    assert slide.max() == pytest.approx(1)
    rows, cols = np.nonzero(slide > 0.5)
    height, width = np.ptp(rows) + 1, np.ptp(cols) + 1
    assert height / width == pytest.approx(2, rel=0.15)  # stretched from 10 to 20
