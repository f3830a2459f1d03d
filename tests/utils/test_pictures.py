"""Images of clouds and values have known answers."""

import numpy as np
import pytest
from matplotlib.text import Text

from qs3.utils.pictures import PANEL, axes_of, cloud_image, sheet, value_image

RNG = np.random.default_rng(0)


def ink(image):
    """[h, w] where something is drawn."""
    return (image != np.frombuffer(bytes.fromhex(PANEL[1:]), np.uint8)).any(axis=2)


def test_up_is_up_and_right_is_right():
    right, up, towards = axes_of(-55, 18)
    assert np.stack([right, up, towards]) @ np.stack([right, up, towards]).T == pytest.approx(
        np.eye(3)
    )
    assert up[2] > 0.9
    pole = np.column_stack([np.zeros((500, 2)), RNG.uniform(0, 2, 500)])
    rows, columns = np.nonzero(ink(cloud_image(pole)))
    assert np.ptp(columns) < 5 < 140 < np.ptp(rows)
    corner = np.concatenate([RNG.uniform(-1, 1, (500, 3)), [[9, 9, 0]]])  # +x, +y is on the right
    assert ink(cloud_image(corner))[:, -10:].any()
    assert np.isfinite(cloud_image(np.ones((1, 3)))).all()


def test_the_nearest_point_stays():
    towards = axes_of(-55, 18)[2]
    line = np.outer([-1.0, 1.0], towards)
    colours = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    drawn = cloud_image(line, colours=colours)
    middle = drawn.shape[0] // 2
    assert drawn[middle, middle].tolist() == [0, 0, 255]


def test_values_have_the_colours_of_the_map_and_unknown_ones_are_dark():
    image = value_image(np.array([[0.0, 1.0, 3.0, np.nan]]), 0, 2, "gray")
    assert image[0].tolist() == [[0] * 3, [128] * 3, [255] * 3, [0x18, 0x14, 0x1C]]


def test_a_sheet_keeps_the_shape_of_its_images():
    wide = np.zeros((20, 60, 3), np.uint8)
    figure = sheet([wide, None], ["a", ""], columns=2, heading="h", rows=["r"], heads=["x", "y"])
    figure.canvas.draw()
    seen = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    rows, columns = np.nonzero((seen == 0).all(axis=2))
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(3, abs=0.1)
    assert {"a", "h", "r", "x", "y"} <= {text.get_text() for text in figure.findobj(Text)}
