"""Twins of a cloud: its whole surface, its points without error, its views; they change no byte."""

import numpy as np
import pytest
import trimesh
from trimesh.proximity import closest_point_naive

from qs3.catalogue import Catalogue
from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError
from qs3.generation.checks import check
from qs3.generation.command import generate
from qs3.generation.provenance import NO_RESIDUAL_M, Keep
from qs3.generation.twins import fused_twins, true_points, whole_surface
from qs3.geometry.cameras import Camera, Intrinsics, look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import DepthFrame
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from qs3.store.store import open_pointset, open_table, read_meta
from qs3.utils.seeding import object_rng
from tests.generation.generating import composed, config, fingerprint

ARRAYS = ("whole", "exact", "view0", "view0_exact", "view1", "view1_exact")
ASKED = ("twins=[whole,exact,views]", "provenance=true", "workers=0")


def two_classes(data_dir, meshes, *overrides):
    return config(data_dir, meshes, "classes=[chair,table]", "splits=[train]", *overrides)


@pytest.fixture(scope="module")
def kept(meshes, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("kept")
    return data_dir / "specklenet10", generate(two_classes(data_dir, meshes, *ASKED))


def array(folder, name):
    return np.array(open_pointset(folder, f"points_{name}").points)


def test_points_move_by_what_they_were_measured_wrong_along_their_rays(kept):
    folder, pointset = kept
    table, _ = open_table(folder)
    cfg = two_classes(folder.parent, None)
    lens = build(cfg.recipe).sensor.intrinsics
    for cloud, exact, rows in zip(pointset.points, array(folder, "exact"), table, strict=True):
        _, u, v, residual, _ = rows.T.astype(float)
        along = np.hypot((u - lens.cx_px) / lens.focal_px, (v - lens.cy_px) / lens.focal_px)
        moved = np.linalg.norm(cloud - exact, axis=1)
        known = residual != NO_RESIDUAL_M
        assert known.mean() > 0.6
        np.testing.assert_allclose(
            moved[known], (np.abs(residual) * np.hypot(1, along))[known], atol=1e-5
        )
        assert (moved[~known] == 0).all()


def test_the_whole_surface_is_that_of_the_placed_mesh(kept):
    folder, pointset = kept
    whole = array(folder, "whole")
    for cloud, scan in zip(whole, pointset.points, strict=True):
        # Scans show the object from 20 to 50 degrees above, so not from below.
        assert cloud[:, 2].min() < scan[:, 2].min() + 0.06
        nearest = np.linalg.norm(scan[:, None] - cloud[None], axis=2).min(1)
        assert np.quantile(nearest, 0.95) < 0.06
        back = np.linalg.norm(scan[None] - cloud[:, None], axis=2).min(1)
        assert np.quantile(back, 0.95) > 0.2  # what no view saw


def test_each_view_is_what_it_gave_to_the_fused_cloud_and_more(kept):
    folder, pointset = kept
    table, _ = open_table(folder)
    for i in range(2):
        view, exact = array(folder, f"view{i}"), array(folder, f"view{i}_exact")
        for k, cloud in enumerate(pointset.points):
            mine = cloud[table[k][:, 0] == i]
            assert len(mine) > 50
            rows = {row.tobytes() for row in view[k]}
            # Farthest points of the view and of all views are not the same, but many are.
            assert np.mean([row.tobytes() in rows for row in mine]) > 0.1
            gap = np.linalg.norm(mine[:, None] - view[k][None], axis=2).min(1).max()
            assert gap < 0.05
            assert 0 < np.median(np.linalg.norm(view[k] - exact[k], axis=1)) < 0.05


def test_asking_for_twins_moves_no_byte_and_workers_and_a_resume_move_none_of_theirs(
    kept, meshes, tmp_path
):
    folder, pointset = kept
    plain = generate(two_classes(tmp_path / "plain", meshes, "workers=0"))
    assert plain.sha256 == pointset.sha256
    bare = tmp_path / "plain/specklenet10"
    for name in ("points.npy", "points_clean.npy", "manifest.csv"):
        assert (bare / name).read_bytes() == (folder / name).read_bytes()
    assert sorted(read_meta(bare)["sha256"]) == ["manifest", "points", "points_clean"]
    made = tmp_path / "specklenet10"
    generate(two_classes(tmp_path, meshes, *ASKED, "limit=1"))
    (made / "meta.yaml").unlink()  # as if killed before the last objects
    with pytest.raises(ConfigError, match="made from other objects"):
        generate(two_classes(tmp_path, meshes, *ASKED))
    generate(two_classes(tmp_path, meshes, *ASKED[:2], "workers=2", "force=true"))
    assert fingerprint(made) == fingerprint(folder)
    for name in ARRAYS:
        file = f"points_{name}.npy"
        assert (made / file).read_bytes() == (folder / file).read_bytes()
    with pytest.raises(ConfigError, match="kept: "):
        generate(two_classes(folder.parent, meshes, "workers=0"))


def test_damage_is_noticed_and_the_file_named(kept, tmp_path):
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in kept[0].iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    data = bytearray((folder / "points_whole.npy").read_bytes())
    data[-1] ^= 1
    (folder / "points_whole.npy").write_bytes(data)
    open_pointset(folder)
    with pytest.raises(DataError, match=r"points_whole\.npy is damaged"):
        open_pointset(folder, "points_whole")
    (folder / "points_whole.npy").write_bytes(data[:-4])
    with pytest.raises(DataError, match=r"points_whole\.npy has \d+ bytes, expected \d+"):
        open_pointset(folder, "points_whole")


def _frame():
    """2 x 3 pixels: the object, 1 cm too far, its surroundings, an edge; one without depth."""
    depth = np.array([[1.01, 1.01, np.nan], [1.5, 1.2, 1.01]], dtype=np.float32)
    clean = np.array([[1.0, 1.0, 1.0], [1.4, np.inf, 1.0]], dtype=np.float32)
    label = np.array([[1, 1, 1], [0, 0, 1]], dtype=np.uint8)
    camera = Camera(Intrinsics(3, 2, 100.0, 1.0, 0.5), np.eye(4))
    blank = np.zeros((2, 3), dtype=np.float32)
    return DepthFrame(camera, 0, 0, 1, depth, clean, label, blank, blank.astype(np.uint8))


def test_only_pixels_of_the_object_have_a_truth():
    frame, moved = _frame(), np.eye(4)
    moved[0, 3] = 0.5  # the pose that is believed
    measured = frame.points(frame.depth_m, moved)
    true = true_points(frame, frame.depth_m, measured, np.eye(4))
    ideal = frame.points(np.ones((2, 3)), np.eye(4))
    np.testing.assert_allclose(true[[0, 1, 4]], ideal[[0, 1, 5]])
    np.testing.assert_array_equal(true[[2, 3]], measured[[2, 3]])


def test_the_truth_is_on_the_pixels_true_ray_where_the_device_believes_another():
    """With the released code's half a pixel, a sphere's exact points lie on the sphere."""
    solid = trimesh.creation.icosphere(5, 0.5)
    mesh = Mesh.from_trimesh(solid)
    pose = look_at(np.array([3.0, 0.0, 0.0]), np.zeros(3))
    sensor = SpeckleStereo(centre_error_px=4.0)
    rng = np.random.default_rng(0)
    frame = sensor.scan((Body(mesh),), np.array(mesh.bounds), pose, MitsubaRenderer(4), rng)
    measured = frame.points(frame.depth_m, pose)
    true = true_points(frame, frame.depth_m, measured, pose)
    known = (frame.label == 1)[np.isfinite(frame.depth_m)]
    assert known.mean() > 0.9
    off = np.linalg.norm(true[known], axis=1) - 0.5
    assert np.abs(off).max() < 1e-3  # 4 px are 7 mm there
    assert np.abs(np.median(measured[known][:, 1])) > 5e-3  # as it is measured


def test_a_view_without_points_repeats_the_one_before_or_the_first():
    clouds = {i: (np.full((3, 3), i, float), np.full((3, 3), i + 0.5)) for i in (1, 3)}
    found = fused_twins(("views", "exact"), clouds, 5, np.array([5, 0, 1, 2]))
    assert [found[f"points_view{i}"][0, 0] for i in range(5)] == [1, 1, 1, 3, 3]
    assert [found[f"points_view{i}_exact"][0, 0] for i in range(5)] == [1.5, 1.5, 1.5, 3.5, 3.5]
    np.testing.assert_array_equal(found["points_exact"][:, 0], [3.5, 1.5, 1.5, 1.5])
    assert found["points_view0"].shape == (4, 3)
    assert fused_twins((), clouds, 5, np.arange(4)) == {}


def test_a_room_scan_has_its_object_whole():
    (item,) = Catalogue(seed=1, train=1, test=0, classes=("chair",)).items()
    cfg = composed("domain=roomscan10", "renderer.samples=2")
    recipe, renderer, mesh = build(cfg.recipe), build(cfg.renderer), item.load()
    name = "chair/train/chair_0000"
    bare = recipe.make(mesh, name, 0, renderer)
    cloud = recipe.make(mesh, name, 0, renderer, Keep(twins=frozenset({"whole", "exact"})))
    assert cloud.arrays["points"].tobytes() == bare.arrays["points"].tobytes()
    assert set(cloud.arrays) - set(bare.arrays) == {"points_whole", "points_exact"}
    placed = recipe.placing.place(mesh, object_rng(0, name, 0), name)
    whole = cloud.arrays["points_whole"]
    np.testing.assert_array_equal(whole, whole_surface(placed, name, 0, 2048))
    solid = trimesh.Trimesh(placed.vertices, placed.faces, process=False)
    assert closest_point_naive(solid, whole[::64].astype(float))[1].max() < 1e-6
    np.testing.assert_allclose([whole.min(0), whole.max(0)], placed.bounds, atol=0.03)
    error = closest_point_naive(solid, cloud.arrays["points_exact"][::64].astype(float))[1]
    assert np.median(error) < 1e-5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["twins=[all]"], "twins is a list of whole, exact, views"),
        (["twins=whole"], "twins is a list of whole, exact, views"),
    ],
)
def test_unknown_twins_are_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        check(composed("domain=specklenet10", *words))


@pytest.mark.parametrize("domain", ["specklenet10_view", "roomscan10"])
def test_the_views_of_a_single_view_are_refused(meshes, tmp_path, domain):
    cfg = composed(f"domain={domain}", "twins=[views]", f"paths.data_dir={tmp_path}")
    with pytest.raises(ConfigError, match="with one view it is the cloud itself"):
        generate(cfg)


def test_a_domain_that_looks_at_nothing_has_no_twins(meshes, tmp_path):
    with pytest.raises(ConfigError, match="looks at nothing, so twins= says"):
        generate(config(tmp_path, meshes, "twins=[whole]", domain="modelnet10"))
