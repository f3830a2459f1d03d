"""All renderers, each once."""

import pytest

from qs3.sensors.renderers.base import RendererSettings
from tests.sensors.renderers.scenes import RENDERERS


@pytest.fixture(
    scope="session",
    params=[
        pytest.param("blender", marks=pytest.mark.blender),
        "mitsuba",
        pytest.param("mitsuba_scalar", marks=pytest.mark.slow),
    ],
)
def shared(request):
    return RENDERERS[request.param]()


@pytest.fixture
def renderer(shared):
    """One renderer for all tests (it must not remember anything), with 16 samples."""
    shared.settings = RendererSettings(samples=16, threads=1)
    return shared
