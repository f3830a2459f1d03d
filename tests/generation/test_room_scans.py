"""One view in a room, cut like an object of a real frame."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from trimesh.proximity import closest_point_naive

from qs3.catalogue import Catalogue
from qs3.config.hydra import build
from qs3.datasets.cutting import Limits, Rules
from qs3.datasets.depth_images import DepthImage, Pinhole
from qs3.generation.kept import Keep
from qs3.generation.room_scans import RoomCamera, one_piece, yaw_between
from qs3.generation.scenes import Room, Support
from qs3.geometry.cameras import Camera, Intrinsics, look_at, project
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import OnFurniture
from qs3.sensors.renderers.base import Scene
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


@given(
    seed=st.integers(0, 10_000),
    yaw=st.floats(-3.1, 3.1),
    side=st.floats(0, 180),
    up=st.floats(0, 1),
)
def test_who_sees_the_front_stands_before_it(seed, yaw, side, up):
    law = RoomCamera(side_deg=side, roll_deg=0)
    box = np.array([[-0.4, -0.3, up], [0.4, 0.3, up + 0.8]])
    pose = law.pose(np.random.default_rng(seed), box, LENS, front_rad=yaw)
    azimuth = np.arctan2(pose[1, 3], pose[0, 3])
    off = np.rad2deg(abs((azimuth - yaw + np.pi) % (2 * np.pi) - np.pi))
    assert off <= side + 1e-6


@given(seed=st.integers(0, 10_000), size=st.floats(0.01, 5))
def test_by_how_much_a_placed_mesh_is_turned(seed, size):
    rng = np.random.default_rng(seed)
    mesh = Mesh(size * rng.normal(size=(12, 3)), np.arange(12).reshape(4, 3))
    placed = OnFurniture().place(mesh, np.random.default_rng(seed))
    yaw = np.random.default_rng(seed).uniform(0, 2 * np.pi)  # the first that is drawn
    assert np.cos(yaw_between(mesh, placed) - yaw) == pytest.approx(1)


def test_what_is_cut_lies_on_the_mesh_and_is_one_side_of_it(made):
    points, twin = (made.cloud.arrays[name] for name in ("points", "points_clean"))
    assert points.shape == twin.shape == (2048, 3)
    assert made.cloud.views == 1
    placed = made.recipe.placing.place(made.mesh, object_rng(0, ID, 0), ID)
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


def test_a_worktop_is_not_its_cabinet_s(made):
    recipe = replace(made.recipe, worktops={"chair": 1.0}, torn=0.0)
    solid = trimesh.creation.box((0.8, 0.5, 0.8))
    mesh = Mesh(np.asarray(solid.vertices), np.asarray(solid.faces))
    highest = recipe.make(mesh, ID, 0, made.renderer).arrays["points_clean"][:, 2].max()
    assert 0.5 < highest < 0.78  # 5 cm and less by the sensor's noise
    whole = replace(recipe, worktops={}).make(mesh, ID, 0, made.renderer)
    assert whole.arrays["points_clean"][:, 2].max() == pytest.approx(0.8, abs=1e-3)


@pytest.fixture(scope="module")
def lamp(made):
    """A table lamp above the floor, as a recipe places it; its id and its seed."""
    for item in Catalogue(seed=1, train=20, test=0, classes=("lamp",)).items():
        mesh = item.load()
        for seed in range(20):
            placed = made.recipe.placing.place(mesh, object_rng(seed, item.id, 0), item.id)
            if placed.bounds[0, 2] > 0.6:
                return SimpleNamespace(mesh=mesh, placed=placed, id=item.id, seed=seed)
    raise AssertionError


@pytest.mark.parametrize("block", [0.0, 1.0])
def test_a_raised_object_stands_on_furniture_that_stands_on_the_floor(made, lamp, block):
    """As a depth image has it: top, floor and object where they are said to be."""
    top = lamp.placed.bounds[0, 2]
    furniture = Support(block=block, min_margin_m=0.2)
    scene = Room(wall=0, max_clutter=5, max_occluders=2, support=furniture)
    eyes = np.array([[2.2, 0.3, 1.5], [2.2, 0.3, 0.25]])  # from above, and below the top
    below = 0
    for seed in range(2):
        bodies = scene.bodies(lamp.placed, eyes, _rng(seed), floor_m=0.0)
        assert [body.label for body in bodies] == [1] + [0] * (len(bodies) - 1)
        floor, under, *pieces = (body.mesh for body in bodies[1:])
        assert floor.bounds[:, 2] == pytest.approx(0, abs=2e-4)
        assert under.bounds[:, 2] == pytest.approx([0, top], abs=2e-4)
        assert trimesh.Trimesh(under.vertices, under.faces).is_watertight
        assert all(piece.bounds[0, 2] == 0 for piece in pieces)
        # Nothing of the room reaches into the furniture: all is outside the circle around it.
        middle = lamp.placed.bounds[:, :2].mean(axis=0)
        radius = np.linalg.norm(under.vertices[:, :2] - middle, axis=1).max()
        for piece in pieces:
            assert np.linalg.norm(piece.vertices[:, :2] - middle, axis=1).min() > radius
        ring = ConvexHull(under.vertices[:, :2])
        alone = bodies[:3]
        for eye in eyes:
            camera = Camera(LENS, look_at(eye, np.array([0, 0, top])))
            (image,) = made.renderer.render(
                Scene(alone, ambient=1.0), [camera], seed=0, geometry=[True]
            )
            place, label = in_world(image, camera)
            reach = outside_by(ring, place)
            inside = reach < -0.02
            assert label.max() == 1
            assert place[label == 1, 2].min() > top - 1e-3
            if eye[2] > top:  # the object's foot on the top, and the floor beside it
                height = place[inside & (label == 0), 2]
                assert (np.abs(height - top) < 1e-3).sum() > 500
                assert height.max() < top + 1e-3
                assert place[label == 1, 2].min() < top + 5e-3
                beside = (reach > 0.02) & (label == 0)
                assert beside.sum() > 500
                np.testing.assert_allclose(place[beside, 2], 0, atol=1e-3)
            # Between legs the floor is seen where the top is above it.
            below += (inside & (np.abs(place[:, 2]) < 1e-3)).sum()
    assert below == 0 if block else below > 500


def outside_by(ring, points):
    """[n] how far points lie outside the sides of a convex ring, from above; below 0: inside."""
    return (points[:, :2] @ ring.equations[:, :2].T + ring.equations[:, 2]).max(axis=1)


def in_world(image, camera):
    """[n, 3] points that the pixels of an image see, and their labels [n]."""
    rows, columns = np.nonzero(np.isfinite(image.depth_m))
    lens, depth = camera.intrinsics, image.depth_m[rows, columns].astype(float)
    local = np.stack(
        [(columns - lens.cx_px) / lens.focal_px, (rows - lens.cy_px) / lens.focal_px, 1 + 0 * rows]
    )
    pose = camera.world_from_camera
    return (local * depth).T @ pose[:3, :3].T + pose[:3, 3], image.label[rows, columns]


def test_a_scan_of_a_raised_object_is_of_it_alone(cfg, made, lamp):
    cloud = made.recipe.make(lamp.mesh, lamp.id, lamp.seed, made.renderer)
    twin = cloud.arrays["points_clean"]
    solid = trimesh.Trimesh(lamp.placed.vertices, lamp.placed.faces, process=False)
    assert closest_point_naive(solid, twin[::32].astype(float))[1].max() < 1e-3


def test_a_piece_is_drawn_among_those_that_are_large_enough():
    depth = np.full((60, 90), 2.0)
    depth[:, 30:60], depth[:, 60:] = 2.4, 2.8
    own = np.ones((60, 90), dtype=bool)
    own[10:, 60:] = False  # 300 pixels, the others 1,800 each
    image = DepthImage(depth, Pinhole(500, 500, 44.5, 29.5), np.eye(3))
    rules = Rules(limits={"default": Limits(pixels=1000)})
    drawn = [one_piece(image, own, "chair", rules, _rng(seed)) for seed in range(60)]
    columns = [tuple(np.unique(np.nonzero(mask)[1])[[0, -1]]) for mask in drawn]
    assert {*columns} == {(0, 29), (30, 59)}
    assert 15 < columns.count((0, 29)) < 45
    assert all(mask.sum() == 1800 for mask in drawn)
    none = replace(rules, limits={"default": Limits(pixels=5000)})
    own[:, 30:] = own[50:, :30] = False
    assert np.array_equal(one_piece(image, own, "chair", none, _rng(0)), own)
    assert not one_piece(image, np.zeros_like(own), "chair", rules, _rng(0)).any()


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
