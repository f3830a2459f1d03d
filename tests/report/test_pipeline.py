"""The pipeline of one object: its residuals are true ones, the figure shows what there is."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.text import Text

from qs3.report.pipeline import makes_rooms, pipeline_figure, room_figure, scan_object
from tests.report.made_runs import not_blank
from tests.running import main

SMALL = ["renderer.samples=2", "views=2"]


@pytest.fixture(scope="module")
def speckle():
    return scan_object(["domain=specklenet10", "sensor=speckle_stereo_small", *SMALL])


def words(figure):
    return " | ".join(text.get_text() for text in figure.findobj(Text))


def test_residuals_are_distances_that_trimesh_finds(speckle):
    solid = trimesh.Trimesh(speckle.mesh.vertices, speckle.mesh.faces, process=False)
    residual = speckle.residual_m
    far = trimesh.proximity.closest_point_naive(solid, speckle.cloud[:200])[1]
    np.testing.assert_allclose(np.abs(residual[:200]), far, atol=3e-3)
    assert 0.001 < np.median(np.abs(residual)) < 0.05
    assert (residual > 0).any()
    assert (residual < 0).any()
    clean = replace(speckle, cloud=speckle.clean)
    assert np.percentile(np.abs(clean.residual_m), 99) < 4e-3
    fused = speckle.fused().astype(np.float32)
    assert {point.tobytes() for point in speckle.cloud} <= {point.tobytes() for point in fused}


def test_the_figure_of_two_cameras(speckle):
    told = words(pipeline_figure(speckle, view=1))
    images = ("view 1", "infrared, right", "disparity", "depth, ", "ok ")
    for stage in (*images, "cloud: 2 views fused", "clean twin", "distance to the mesh"):
        assert stage in told


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["time_of_flight", "blensor_tof"])
def test_a_sensor_without_disparity(sensor):
    one = scan_object(["domain=specklenet10", f"sensor={sensor}", *SMALL[:2], "views=1"])
    assert "disparity" not in words(pipeline_figure(one))


def test_surface_samples_are_a_cloud_and_nothing_else():
    one = scan_object(["domain=modelnet10"])
    assert "samples of the surface" in (told := words(pipeline_figure(one)))
    assert "view" not in told
    assert one.residual_m.max() < 5e-3


def test_a_room_and_what_is_cut_from_it():
    small = ["domain=rooms10", "limit=3", "rooms=0.1", "recipe.views=3"]
    assert makes_rooms(small)
    assert not makes_rooms(["domain=specklenet10"])
    told = words(room_figure(small))
    assert "room/train/room_000000" in told
    cut, seen = map(int, re.search(r"(\d+) clouds of (\d+) pictures", told).groups())
    assert 0 < told.count("depth to") == seen <= 3
    assert 0 < len(re.findall(r"\w+, \d\.\d\d m", told)) <= cut


def test_command_with_a_mesh_of_ones_own(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    out = tmp_path / "p.png"
    asked = ["report", "pipeline", "domain=modelnet10", f"out={out}"]
    assert main([*asked, f"mesh={tmp_path / 'box.ply'}"]) == 0
    assert not_blank(out)
