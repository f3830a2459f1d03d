"""Renders have the same bytes where Dr.Jit would by itself take other numbers of rays at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers import llvm
from qs3.sensors.renderers.base import Body, Image, Scene
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.renderers.scenes import busy_camera, busy_scene, wall


@pytest.fixture
def renderer() -> MitsubaRenderer:
    made = MitsubaRenderer()
    if not made.variant.startswith("llvm_"):
        pytest.skip("nothing is compiled by LLVM")
    return made


def careless() -> Scene:
    """Triangles of two colours over each other in one tilted plane: which is hit first is a tie."""
    rng = np.random.default_rng(0)
    bodies = []
    for label, albedo in ((1, 0.3), (2, 0.9)):
        xy = rng.uniform(-0.6, 0.6, (500, 1, 2)) + rng.normal(scale=0.15, size=(500, 3, 2))
        xy = xy.reshape(-1, 2)
        vertices = np.column_stack([xy, 1.2 + xy @ [0.3137, 0.2719]])
        bodies.append(Body(Mesh(vertices, np.arange(1500).reshape(-1, 3)), albedo, label))
    return replace(busy_scene(), bodies=(*bodies, wall(1.9)))


def rendered(renderer: MitsubaRenderer) -> Image:
    (image,) = renderer.render(careless(), [busy_camera()], seed=0, geometry=[True])
    return image


def has_avx512() -> bool:
    """Whether this is known to be a processor on which Embree takes sixteen rays as one."""
    told = Path("/proc/cpuinfo")
    return told.is_file() and " avx512dq" in told.read_text()


@pytest.mark.parametrize("width", [4, 16])
def test_whatever_the_processor_would_take(renderer, monkeypatch, width):
    before = rendered(renderer)
    with monkeypatch.context() as patched:
        patched.setattr(llvm, "WIDTH", width)
        other = rendered(renderer)
        assert llvm.fix_width() == width
    after = rendered(renderer)
    np.testing.assert_array_equal(after.radiance, before.radiance)
    np.testing.assert_array_equal(after.depth_m, before.depth_m)
    if width == 16 and has_avx512():  # else Embree takes eight twice, and there is nothing to fix
        assert (other.radiance != before.radiance).any()
    assert "width" not in renderer.provenance()
