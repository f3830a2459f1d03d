"""A depth image as the scene: its light, shadows and steps are those of the meshes it shows."""

import numpy as np
import pytest

from qs3.calibration import bench, edges, planes
from qs3.calibration.subject import load
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.optics.visibility import sample_centres
from qs3.sensors.renderers.base import Projector, Scene
from qs3.sensors.renderers.depth import DepthRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.by_depth import ByDepth
from tests.sensors.scenery import POSE, plane, rectangle

LENS = Intrinsics.centred(240, 180, 300.0)
SCENES = {
    "plane": (plane(1.2, 0.8),),
    "tilted": (plane(1.5, 1.2, tilt_deg=50),),
    "step": (rectangle(1.0, -0.15, 0.1, albedo=0.5), rectangle(1.6, -1.5, 1.5, -1.5, 1.5)),
}


@pytest.fixture(scope="module")
def fine():
    return MitsubaRenderer(samples=64)


@pytest.mark.parametrize("name", SCENES)
def test_images_are_those_of_the_meshes(name, fine):
    bodies, camera = SCENES[name], Camera(LENS, POSE)
    right = camera.moved((0.06, 0, 0))
    middle = camera.moved((0.03, 0, 0)).world_from_camera
    slide = Speckle(columns=160, rows=120, dot_px=2).slide
    scene = Scene(bodies, Projector(middle, slide, 0.45, 2.0), ambient=0.1)
    how = {"seed": 0, "geometry": [True, False]}
    wanted = fine.render(scene, [camera, right], **how)
    found = ByDepth(fine).render(scene, [camera, right], **how)
    np.testing.assert_allclose(found[0].depth_m, wanted[0].depth_m, rtol=1e-5)
    np.testing.assert_array_equal(found[0].label, wanted[0].label)
    assert np.abs(found[0].cosine - wanted[0].cosine).mean() < 1e-4
    for a, b in zip(found, wanted, strict=True):
        assert np.corrcoef(a.radiance.ravel(), b.radiance.ravel())[0, 1] > 0.985
        assert a.radiance.mean() == pytest.approx(b.radiance.mean(), rel=0.01)
        assert ((a.radiance > 0) == (b.radiance > 0)).mean() > 0.99


def test_a_step_is_one_and_a_steep_surface_is_none():
    x = np.arange(40) - 19.5
    steep = 1 / (0.6 + 0.025 * x) * np.ones((30, 1))  # 4 % of the depth a pixel
    step = np.where(x < 0, 1.0, 1.06) * np.ones((30, 1))
    holes = np.where((np.arange(40) % 9) == 0, 0, 1.0) * np.ones((30, 1))
    for depth, count in ((steep, 39), (step, 38), (holes, 30)):
        _, linked, slope_x, slope_y = DepthRenderer(depth, (60.0, 60.0, 19.5, 14.5))._surface
        assert (linked.sum(axis=1) == count).all()
        np.testing.assert_allclose(slope_y, 0, atol=1e-7)
        np.testing.assert_allclose(slope_x, 0.025 if count == 39 else 0, atol=1e-6)


def test_nothing_and_places_elsewhere():
    empty = DepthRenderer(np.zeros((6, 8)), (8.0, 8.0, 3.5, 2.5))
    camera = Camera(Intrinsics.centred(8, 6, 8.0), np.eye(4))
    (image,) = empty.render(Scene((), ambient=1.0), [camera], seed=0, geometry=[True])
    assert not image.radiance.any()
    assert np.isinf(image.depth_m).all()
    np.testing.assert_array_equal(sample_centres(camera, empty, 0)[0], np.arange(8))
    with pytest.raises(AssertionError, match="along its rows"):
        empty.render(Scene(()), [camera.moved((0, 0.1, 0))], seed=0, geometry=[False])


# Distances and two tilts of a bench, each as finely as there: fewer planes hold or miss by chance.
@pytest.mark.slow
@pytest.mark.parametrize("name", bench.DEFAULT_SENSORS)
def test_planes_and_edges_lie_in_the_bands_of_the_rendered_sensor(name):
    import pandas as pd

    subject, renderer = load(name), MitsubaRenderer(samples=16)
    conditions = [(*each[:3], 16, 24) for each in bench.conditions(subject, True)]
    bands = []
    for one in (renderer, ByDepth(renderer)):
        rows = [planes.measure(subject, one, *each) for each in conditions]
        edge = edges.measure(subject, one, 3)
        bands.append(bench.judge(subject, pd.DataFrame(rows), edge))
    for rendered, found in zip(*bands, strict=True):
        assert found.holds or not rendered.holds, (rendered, found)
