"""The look of figures."""

from __future__ import annotations

import warnings

import pytest

from qs3.utils.plotting import blank, boxes_for_letters, save_png


def test_letters_that_the_font_lacks_are_boxes_without_a_warning(tmp_path):
    figure = blank(1, 1, 50)
    figure.text(0.5, 0.5, "椅子")
    save_png(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size
    with pytest.warns(UserWarning, match="else"), boxes_for_letters():
        warnings.warn("something else", UserWarning, stacklevel=1)
