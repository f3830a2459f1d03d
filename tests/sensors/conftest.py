"""Renderers that the tests of sensors share."""

import pytest

from qs3.sensors.renderers.mitsuba import MitsubaRenderer


@pytest.fixture(scope="session")
def renderer():
    """Mitsuba with few samples a pixel; they change the cost, not the noise of a depth."""
    return MitsubaRenderer(samples=4)
