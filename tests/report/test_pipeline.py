"""The pipeline of one object: its residuals are true ones, the figure shows what there is."""

import numpy as np
import pytest
import trimesh

from qs3.errors import ConfigError
from qs3.meshes.mesh import Mesh
from qs3.report.pipeline import pipeline_figure, scan_object, signed_distance_m
from tests.report.made_runs import not_blank
from tests.running import main

SMALL = ["renderer=mitsuba", "renderer.samples=2", "views=2"]


@pytest.fixture(scope="module")
def speckle():
    return scan_object(["domain=specklenet10", "sensor=speckle_stereo_small", *SMALL])


def words(figure):
    return " | ".join(text.get_text() for text in figure.texts)


def test_residuals_behind_and_before_a_wall():
    wall = Mesh([[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]], [[0, 1, 2], [0, 2, 3]])
    points = np.array([[0, 0, 0.02], [1, 2, -0.03], [0.5, 0, 0.0]])
    above, below = np.array([[0, 0, 4.0]] * 3), np.array([[1, 0, -4.0]] * 3)
    assert signed_distance_m(points, above, wall) == pytest.approx([-0.02, 0.03, 0])
    assert signed_distance_m(points, below, wall) == pytest.approx([0.02, -0.03, 0])


def test_residuals_of_a_scan_are_distances_that_trimesh_finds(speckle):
    solid = trimesh.Trimesh(speckle.mesh.vertices, speckle.mesh.faces, process=False)
    some = slice(0, 200)
    far = trimesh.proximity.closest_point_naive(solid, speckle.cloud[some])[1]
    np.testing.assert_allclose(np.abs(speckle.residual_m[some]), far, atol=1e-9)
    assert 0.001 < np.median(np.abs(speckle.residual_m)) < 0.05
    assert (speckle.residual_m > 0).any()
    assert (speckle.residual_m < 0).any()


def test_the_clean_twin_has_no_residual_and_every_point_was_measured(speckle):
    eyes = np.repeat(speckle.views[0].world_from_camera[None, :3, 3], len(speckle.clean), axis=0)
    assert np.abs(signed_distance_m(speckle.clean, eyes, speckle.mesh)).max() < 1e-5
    fused = speckle.fused().astype(np.float32)
    assert {point.tobytes() for point in speckle.cloud} <= {point.tobytes() for point in fused}


def test_the_figure_of_two_cameras(speckle):
    told = words(pipeline_figure(speckle, view=1))
    images = ("view 1: infrared", "infrared, right", "disparity", "depth as measured")
    for stage in (*images, "cloud: 2 views fused", "clean twin", "distance to the mesh"):
        assert stage in told
    assert ": none" not in told
    with pytest.raises(ConfigError):
        pipeline_figure(speckle, view=2)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["time_of_flight", "blensor_tof"])
def test_a_sensor_without_disparity(sensor):
    one = scan_object(["domain=specklenet10", f"sensor={sensor}", *SMALL[:2], "views=1"])
    assert "disparity: none" in words(pipeline_figure(one))


def test_surface_samples_are_a_cloud_and_nothing_else():
    one = scan_object(["domain=modelnet10"])
    assert "samples of the surface" in (told := words(pipeline_figure(one)))
    assert "view" not in told
    assert one.residual_m.max() < 1e-6


def test_command_with_a_mesh_of_ones_own(tmp_path, capsys):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    out = tmp_path / "p.png"
    asked = ["report", "pipeline", "domain=modelnet10", f"out={out}"]
    assert main([*asked, f"mesh={tmp_path / 'box.ply'}"]) == 0
    assert not_blank(out)
    assert main([*asked, "object=nothing"]) == 1
    assert "ConfigError: object=nothing" in capsys.readouterr().err
