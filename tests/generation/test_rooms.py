"""Rooms: what is cut is what the pictures show, and nothing else decides it."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.config.hydra import build
from qs3.datasets.cutting import Limits, Rules
from qs3.datasets.depth_images import DepthImage, Pinhole
from qs3.generation.command import generate
from qs3.generation.furnishing import Furnished, Thing
from qs3.generation.kept import Keep
from qs3.generation.plan import planned
from qs3.generation.rooms import StandingCamera, _Shelf, parts
from qs3.geometry.cameras import Camera, Intrinsics, project
from qs3.store.store import open_pointset
from qs3.utils.seeding import object_rng
from tests.generation.generating import composed

LENS = Intrinsics.centred(640, 480, 580.0)
ID = "room/train/room_000003"
ROOMS = ("domain=rooms10", "limit=3", "rooms=0.1")


@pytest.fixture(scope="module")
def made():
    plan = planned(composed(*ROOMS))
    # Careful masks of whole objects: each point then lies on its object.
    exact = replace(plan.recipe.mask, min_grow_px=0, max_grow_px=0, max_shift_px=0)
    recipe, renderer = replace(plan.recipe, mask=exact, by_class=0.0), build(plan.cfg.renderer)
    cloud = recipe.make("train", ID, 0, renderer)
    return SimpleNamespace(recipe=recipe, renderer=renderer, cloud=cloud)


def box_of(low, high):
    return SimpleNamespace(bounds=np.array([low, high]))


@given(seed=st.integers(0, 10_000), size=st.tuples(*[st.floats(0.05, 1.6)] * 3), up=st.floats(0, 1))
def test_somebody_stands_in_the_room_and_sees_the_thing(seed, size, up):
    half = np.array(size) / 2
    middle = np.array([2.6, 3.4, up + half[2]])
    thing = Thing(box_of(middle - half, middle + half), None, "")
    chest = box_of([0.5, 0.5, 0.0], [1.5, 1.5, 2.0])
    room = Furnished(np.array([6.0, 5.5]), [thing], [chest], [])
    law = StandingCamera(min_pitch_deg=-80, max_pitch_deg=80, roll_deg=0)
    pose = law.before(np.random.default_rng(seed), thing, room, LENS)
    if pose is None:
        return
    eye, near = pose[:3, 3], min(1, max(size) / 0.35)
    assert 1.1 <= eye[2] <= 1.7
    assert ((eye[:2] > 0.15) & (eye[:2] < room.size_m - 0.15)).all()
    assert not ((eye > chest.bounds[0] - 0.3) & (eye < chest.bounds[1] + 0.3)).all()
    away, radius = np.linalg.norm(eye[:2] - middle[:2]), np.hypot(*half[:2])
    assert radius + 0.6 * near - 1e-9 <= away <= max(4.5 * near, radius + 0.6 * near) + 1e-9
    pixel, depth = project(middle[None], Camera(LENS, pose))
    assert depth > 0
    # Two angles after each other are not a point of the plane: a pixel or a few beside it.
    off = np.abs(pixel[0] - [LENS.cx_px, LENS.cy_px])
    assert (off <= np.array([320, 240]) * 0.85 * 1.3).all()


def test_what_is_cut_lies_on_the_things_that_it_is_called(made):
    recipe, frames = made.recipe, []
    keep = Keep(view=lambda *given: frames.append(given))
    cloud = recipe.make("train", ID, 0, made.renderer, keep)
    assert len(frames) > 3
    assert {given[0] for given in frames} == {ID}
    assert len(cloud.found) == len(cloud.arrays["points"]) > 5
    meshes = {(mesh := item.load()).sha256: (item, mesh) for item in recipe.shelves["train"]}
    for found, points in zip(cloud.found, cloud.arrays["points"], strict=True):
        item, mesh = meshes[found.mesh_sha256]
        assert (item.cls, item.origin) == (found.cls, found.origin)
        longest = np.linalg.norm(np.ptp(mesh.bounds, axis=0))
        assert np.linalg.norm(np.ptp(points, axis=0)) <= longest + 0.15  # its steps of depth
        assert points.shape == (1024, 3)
        assert -0.1 < points[:, 2].min() < 2.6
        assert found.valid_points >= recipe.rules.limits_of(found.cls).pixels * 0.9
    for cls, count in Counter(found.cls for found in cloud.found).items():
        assert count < recipe.most * recipe.shares.get(cls, 1.0) + 1


def test_the_same_room_whatever_was_made_before_or_is_kept(made):
    made.recipe.make("train", "room/train/room_000008", 0, made.renderer)
    keep = Keep(view=lambda *given: None)
    again = made.recipe.make("train", ID, 0, made.renderer, keep)
    np.testing.assert_array_equal(again.arrays["points"], made.cloud.arrays["points"])
    assert again.found == made.cloud.found
    other = made.recipe.make("train", ID, 1, made.renderer)
    assert not np.array_equal(other.arrays["points"][:3], again.arrays["points"][:3])


def test_a_worktop_is_not_its_cabinet_s(made):
    recipe, lost = replace(made.recipe, worktops={"cabinet": 1.0}), []
    for room_id in (f"room/train/room_{k}" for k in range(4)):
        shelf = _Shelf(recipe.shelves["train"], recipe.shares)
        room = recipe.furnishing.furnish(shelf.draw, object_rng(0, room_id, 0))
        tops = {thing.sha256: thing.mesh.bounds[1, 2] for thing in room.things}
        cloud = recipe.make("train", room_id, 0, made.renderer)
        for of, points in zip(cloud.found, cloud.arrays["points"], strict=True):
            if of.cls == "cabinet":
                lost.append(max(tops[of.mesh_sha256] - points[:, 2].max(), 0))
    assert lost
    assert min(lost) > 0.03


def test_depth_edges_part_a_class_into_objects():
    depth = np.full((40, 90), 2.0)
    depth[:, 30:60] = 3.0
    mask = np.ones(depth.shape, bool)
    depth[:, 85:] = 1.0  # five columns: 200 pixels
    image = DepthImage(depth, Pinhole(500, 500, 45, 20), np.eye(3))
    rules = Rules(erode_px=0, limits={"chair": Limits(pixels=1100), "lamp": Limits(pixels=5000)})
    found = [
        np.unique(np.nonzero(part)[1])[[0, -1]].tolist()
        for part in parts(image, mask, "chair", rules)
    ]
    assert found == [[0, 29], [30, 59]]  # of 25 columns the third has 1,000 pixels
    assert not list(parts(image, mask, "lamp", rules))


def test_a_dataset_of_rooms_is_the_same_for_any_number_of_workers(tmp_path):
    a, b = (
        generate(
            composed(*ROOMS, f"paths.data_dir={tmp_path / str(workers)}", f"workers={workers}")
        )
        for workers in (0, 2)
    )
    assert a.sha256 == b.sha256
    data = open_pointset(tmp_path / "0" / "rooms10")
    assert set(data.splits) == {"train", "test"}
    assert len(set(data.ids)) == len(data) > 10
    order = [data.ids[i].split("/")[0] for i in range(len(data))]
    assert order == sorted(order, key=list(data.classes).index)
    rooms = {name.rsplit("/", 1)[1].rsplit("_", 1)[0] for name in data.ids}
    assert rooms <= {f"room_{k:06d}" for k in range(3)}  # a tenth of three meshes a class
