"""One view in a room, cut like an object of a real frame."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from trimesh.proximity import closest_point_naive

from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.generation.provenance import Keep
from qs3.generation.recipes import TooFewPointsError
from qs3.generation.room_scans import RoomCamera
from qs3.generation.scenes import Room
from qs3.geometry.cameras import Camera, Intrinsics, project
from qs3.meshes.catalogue import Catalogue
from qs3.meshes.mesh import Mesh
from qs3.utils.seeding import object_rng
from tests.generation.generating import composed

LENS = Intrinsics.centred(640, 480, 580.0)
ID = "chair/train/chair_0000"


def chair():
    (item,) = Catalogue(seed=1, train=1, test=0, classes=("chair",)).items()
    return item.load()


@pytest.fixture(scope="module")
def cfg():
    return composed("domain=roomscan10", "renderer.samples=2")


@pytest.fixture(scope="module")
def made(cfg):
    recipe, renderer, mesh = build(cfg.recipe), build(cfg.renderer), chair()
    first = recipe.make(mesh, ID, 0, renderer, Keep(provenance=True))
    return SimpleNamespace(recipe=recipe, renderer=renderer, mesh=mesh, cloud=first)


@given(
    seed=st.integers(0, 10_000),
    size=st.tuples(*[st.floats(0.2, 2.2)] * 3),
    up=st.floats(0, 1),
)
def test_the_camera_stands_in_the_room_and_sees_the_middle_of_the_object(seed, size, up):
    half = np.array(size) / 2
    middle = np.array([0.3, -2.0, up + half[2]])
    box = np.stack([middle - half, middle + half])
    law = RoomCamera(min_pitch_deg=-80, max_pitch_deg=80, roll_deg=0)
    pose = law.pose(np.random.default_rng(seed), box, LENS)
    away = np.linalg.norm(pose[:2, 3] - middle[:2])
    assert 1.1 <= pose[2, 3] <= 1.7
    assert away >= np.hypot(*half[:2]) + 0.6 - 1e-9
    assert 1.3 <= away <= max(4.5, np.hypot(*half[:2]) + 0.6) + 1e-9
    pixel, depth = project(middle[None], Camera(LENS, pose))
    assert depth > 0
    # Two angles after each other are not a point of the plane: a pixel or a few beside it.
    off = np.abs(pixel[0] - [LENS.cx_px, LENS.cy_px])
    assert (off <= np.array([320, 240]) * 0.85 * 1.25).all()


def test_pitch_is_kept_within_its_range():
    box = np.array([[-0.2, -0.2, 0], [0.2, 0.2, 0.1]])
    law = RoomCamera(min_pitch_deg=5, max_pitch_deg=10, roll_deg=0)
    for seed in range(20):
        ahead = law.pose(np.random.default_rng(seed), box, LENS)[:3, 2]
        assert 5 - 1e-6 <= np.rad2deg(-np.arcsin(ahead[2])) <= 10 + 1e-6


def test_a_range_upside_down_names_its_key():
    with pytest.raises(ConfigError, match=r"recipe\.camera\.min_height_m=2 is above"):
        RoomCamera(min_height_m=2)


@pytest.mark.parametrize("word", ["views=3", "crop=box"])
def test_what_a_scan_of_a_room_does_not_have_is_refused(word):
    with pytest.raises(ConfigError, match=f"^.*{word.split('=')[0]}"):
        build(composed("domain=roomscan10", word).recipe)


def test_what_is_cut_lies_on_the_mesh_and_is_one_side_of_it(made):
    points, twin = (made.cloud.arrays[name] for name in ("points", "points_clean"))
    assert points.shape == twin.shape == (2048, 3)
    assert made.cloud.views == 1
    placed = made.recipe._placed(made.mesh, "chair", ID, object_rng(0, ID, 0))
    solid = trimesh.Trimesh(placed.vertices, placed.faces, process=False)
    for cloud, most in ((twin, 1e-3), (points, 0.05)):
        distance = closest_point_naive(solid, cloud[::32].astype(float))[1]
        assert np.quantile(distance, 0.9) < most
    eye = made.cloud.frames[0].camera.world_from_camera[:3, 3]
    # Nothing of the far side: the mesh covers no point of the true cloud.
    assert nearest_hit(eye, twin[::16].astype(float), placed).min() > 1 - 5e-3


def test_the_same_seed_gives_the_same_bytes_and_what_is_kept_changes_none(made):
    again = made.recipe.make(made.mesh, ID, 0, made.renderer)
    other = made.recipe.make(made.mesh, ID, 1, made.renderer)
    np.testing.assert_array_equal(again.arrays["points"], made.cloud.arrays["points"])
    assert not np.array_equal(other.arrays["points"], made.cloud.arrays["points"])
    assert "provenance" not in again.arrays
    assert made.cloud.arrays["provenance"].shape == (2048, 5)


def test_an_object_that_no_picture_shows_well_says_why(made):
    far = replace(made.recipe.camera, min_distance_m=30, max_distance_m=31)
    recipe = replace(made.recipe, camera=far, attempts=2)
    with pytest.raises(TooFewPointsError, match=r"none of 2 pictures .* pixels with depth"):
        recipe.make(made.mesh, ID, 0, made.renderer)


def test_things_that_stand_on_others_do_so_half_of_the_time(made):
    heights = [
        made.recipe._placed(made.mesh, "lamp", "lamp/x", _rng(seed)).bounds[0, 2]
        for seed in range(200)
    ]
    raised = np.array(heights) > 1e-9
    assert 70 < raised.sum() < 130
    assert 0.4 <= min(np.array(heights)[raised]) < max(heights) <= 0.8
    assert made.recipe._placed(made.mesh, "chair", "chair/x", _rng(1)).bounds[0, 2] == 0


def test_pieces_between_camera_and_object_cover_some_of_it():
    solid = trimesh.creation.box((0.6, 0.6, 0.9), transform=np.eye(4))
    mesh = Mesh(solid.vertices + np.array([0, 0, 0.45]), solid.faces)
    eye = np.array([[3.0, 0.0, 1.3]])
    covered = []
    for seed in range(60):
        scene = Room(wall=0, max_clutter=0, max_occluders=0, max_between=2)
        bodies = scene.bodies(mesh, eye, np.random.default_rng(seed))
        pieces = [body.mesh for body in bodies[2:]]
        assert all(piece.bounds[1, 2] <= 0.8 + 1e-9 for piece in pieces)
        covered.append(any((nearest_hit(eye[0], mesh.vertices, p) < 1).any() for p in pieces))
    assert 10 < sum(covered) < 55


def nearest_hit(eye, points, mesh):
    """[n] where the way from the eye (0) to each point (1) first meets the mesh; inf: nowhere."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]][None] for i in range(3))
    ray = (points - eye)[:, None]
    across = np.cross(ray, c - a)
    det = ((b - a) * across).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((eye - a) * across).sum(-1) / det
        q = np.cross(eye - a, b - a)
        v = (ray * q).sum(-1) / det
        t = ((c - a) * q).sum(-1) / det
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9), t, np.inf).min(1)


def _rng(seed):
    return np.random.default_rng(seed)
