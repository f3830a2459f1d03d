from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import RenderError
from qs3.geometry.cameras import Window
from qs3.sensors.renderers.base import Body, RendererSettings
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.renderers.scenes import busy_camera, busy_scene, dots, octahedron, wall


def test_unknown_variant_is_refused():
    with pytest.raises(RenderError, match="fast"):
        MitsubaRenderer(variant="fast")


def test_window_has_the_same_bytes_as_the_whole():
    renderer = MitsubaRenderer()
    if renderer.variant == "scalar_rgb":
        pytest.skip("Mitsuba's own samplers know only the window")
    window = Window(31, 17, 40, 32)
    whole, part = (
        renderer.render(busy_scene(), [busy_camera(w)], seed=4, geometry=[False])[0]
        for w in (None, window)
    )
    np.testing.assert_array_equal(part.radiance, whole.radiance[window.slices])


def test_kernels_are_compiled_once():
    renderer = MitsubaRenderer()
    if renderer.variant == "scalar_rgb":
        pytest.skip("nothing is compiled")
    import drjit as dr

    scene = busy_scene()
    renderer.render(scene, [busy_camera()], seed=0, geometry=[True])
    other = replace(
        scene,
        bodies=(Body(octahedron((0, 0, 1), 0.2), 0.5), wall(2.0), wall(3.0)),
        projector=replace(scene.projector, slide=dots(20, seed=9), tan_half_width=0.4),
        ambient=0.7,
    )
    renderer.settings = RendererSettings(samples=5)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        camera = busy_camera(Window(10, 10, 33, 21))
        renderer.render(other, [camera, camera.moved((0.1, 0, 0))], seed=3, geometry=[True, True])
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history
    assert all(kernel["cache_hit"] for kernel in history)


def test_variant_of_others_in_the_process_does_not_matter():
    renderer = MitsubaRenderer()
    call = {"seed": 0, "geometry": [True]}
    (before,) = renderer.render(busy_scene(), [busy_camera()], **call)
    import mitsuba

    mitsuba.set_variant("scalar_spectral")
    (after,) = renderer.render(busy_scene(), [busy_camera()], **call)
    np.testing.assert_array_equal(before.radiance, after.radiance)
