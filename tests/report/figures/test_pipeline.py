"""The pipeline of one object: its residuals are true ones, the figure shows what there is."""

import matplotlib.image
import numpy as np
import pytest
import trimesh

from qs3.errors import DataError
from qs3.generation.command import generate
from qs3.generation.view_files import load_views
from qs3.meshes.mesh import Mesh
from qs3.report.figures.pipeline import kept_object, scan_object, signed_distance_m
from qs3.report.figures.pipeline_figure import pipeline_figure
from tests.generation.generating import config
from tests.running import main

SMALL = ["renderer=mitsuba", "renderer.samples=2", "views=2"]
CHAIR = "chair/train/chair_0000"


@pytest.fixture(scope="module")
def speckle():
    return scan_object(["domain=specklenet10", "sensor=speckle_stereo_small", *SMALL])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """One chair of the catalogue, with its views."""
    root = tmp_path_factory.mktemp("kept")
    chosen = ["classes=[chair]", "catalogue.train=1", "catalogue.test=0", "keep_views=true"]
    generate(config(root, None, "workers=0", *chosen))
    return root / "specklenet10"


def titles(figure):
    return [ax.get_title() for ax in figure.axes if ax.get_title()]


def words(figure):
    return " ".join(text.get_text() for ax in figure.axes for text in ax.texts).replace("\n", " ")


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
    figure = pipeline_figure(speckle, view=1)
    told = " | ".join(titles(figure))
    images = ("view 1: infrared, left", "infrared, right", "disparity", "depth as measured")
    clouds = ("cloud: 2 views fused", "clean twin", "residuals: distance to the mesh")
    for stage in images + clouds:
        assert stage in told
    assert "none" not in words(figure)
    bars = [bar.get_xlabel() for ax in figure.axes for bar in ax.child_axes]
    assert {"px", "m"} <= set(bars)
    (residuals,) = [ax for ax in figure.axes if "residuals" in ax.get_title()]
    low, high = residuals.collections[0].get_clim()
    assert low == -high
    assert high >= 1000 * np.percentile(np.abs(speckle.residual_m), 95) * 0.999


@pytest.mark.parametrize(
    ("sensor", "there", "missing"),
    [
        ("kinect_v1", "stored picture of the pattern", "scale"),
        ("time_of_flight", "view 0: infrared", "does not triangulate"),
        ("blensor_tof", "depth as measured", "makes no picture"),
    ],
)
def test_other_sensors_say_what_they_lack(sensor, there, missing):
    one = scan_object(["domain=specklenet10", f"sensor={sensor}", *SMALL[:2], "views=1"])
    figure = pipeline_figure(one)
    assert there in " | ".join(titles(figure))
    lacks = words(figure)
    assert ("none" not in lacks) if missing == "scale" else (missing in lacks)


def test_surface_samples_are_a_cloud_and_nothing_else():
    one = scan_object(["domain=modelnet10"])
    figure = pipeline_figure(one)
    assert "No sensor looked at it" in words(figure)
    assert "on the surface, but for rounding" in " ".join(titles(figure))
    assert one.residual_m.max() < 1e-6


def test_a_dataset_that_kept_its_views_gives_the_same(dataset, speckle):
    one = kept_object(dataset)
    assert one.name == CHAIR
    np.testing.assert_array_equal(one.cloud, speckle.cloud)
    np.testing.assert_array_equal(one.clean, speckle.clean)
    np.testing.assert_array_equal(one.residual_m, speckle.residual_m)
    for ours, theirs in zip(one.views, speckle.views, strict=True):
        for name, image in theirs.frame.images.items():
            np.testing.assert_array_equal(ours.frame.images[name], image)
        np.testing.assert_array_equal(ours.believed, theirs.believed)


def test_command(dataset, tmp_path, capsys):
    out = tmp_path / "sub" / "p.png"
    words = [f"dataset={dataset}", f"object={CHAIR}", "view=1", f"out={out}"]
    assert main(["report", "pipeline", *words]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    image = matplotlib.image.imread(out)[..., :3]
    assert image.shape[1] > 1500
    assert 0.05 < (image.min(axis=2) < 0.8).mean() < 0.6  # neither blank nor black


def test_own_mesh(tmp_path):
    trimesh.creation.box((0.5, 0.5, 0.9)).export(tmp_path / "box.ply")
    mine = f"mesh={tmp_path / 'box.ply'}"
    paths = [tmp_path / "p.png", tmp_path / "q.png"]
    for path in paths:
        assert main(["report", "pipeline", "domain=modelnet10", mine, f"out={path}"]) == 0
    assert paths[0].stat().st_size > 10_000
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "missing argument"),
        (["domain=modelnet10", "dataset=DATA"], "give one of them"),
        (["domain=nothing10"], "nothing10"),
        (["domain=depthscannet10"], "published, not generated"),
        (["domain=modelnet10", "object=chair/train/chair_9999"], "such as chair/"),
        (["domain=modelnet10", "mesh=nowhere.ply"], "no such file"),
        (["domain=modelnet10", "mesh=."], "is a folder"),
        (["domain=modelnet10", "view=one"], "view must be a whole number"),
        (["domain=specklenet10", "sensor=none"], "choose another"),
        (["domain=specklenet10", "sensor.nothing=1"], "nothing"),
        (["dataset=nowhere"], "nowhere"),
        (["dataset=DATA", "object=bed/1"], "object=bed/1 is not in"),
        (["dataset=DATA", "view=7"], "view=7: chair/train/chair_0000 has the views 0, 1"),
        (["dataset=DATA", "sensor=kinect_v1"], "sensor=kinect_v1 goes with domain="),
    ],
)
def test_errors_for_people(arguments, message, dataset, tmp_path, capsys):
    arguments = [word.replace("DATA", str(dataset)) for word in arguments]
    assert main(["report", "pipeline", *arguments, f"out={tmp_path / 'p.png'}"]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_damaged_or_missing_views(dataset, tmp_path, capsys):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    path = copy / "views" / CHAIR / "view_0.npz"
    path.write_bytes(path.read_bytes()[:500])
    assert main(["report", "pipeline", f"dataset={copy}"]) == 1
    assert f"{path} is damaged" in capsys.readouterr().err
    shutil.rmtree(copy / "views")
    assert main(["report", "pipeline", f"dataset={copy}"]) == 1
    assert "keep_views=true" in capsys.readouterr().err


def test_any_flipped_byte_of_a_view_is_read_right_or_refused(dataset, tmp_path):
    """zlib, zip and numpy each have errors of their own."""
    whole = (dataset / "views" / CHAIR / "view_0.npz").read_bytes()
    path = tmp_path / "views" / CHAIR / "view_0.npz"
    path.parent.mkdir(parents=True)
    messages = []
    for at in np.random.default_rng(0).integers(len(whole), size=150):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            load_views(tmp_path / "views", CHAIR)
        except DataError as error:
            messages.append(str(error))
    assert all("is damaged" in message for message in messages)
    assert len(messages) > 100  # the others hit bytes that mean nothing, such as dates
