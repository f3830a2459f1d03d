"""Where things stand in a room; each mesh here is a box with a low step at its front (-y)."""

from functools import partial

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.catalogue import Catalogue
from qs3.generation.furnishing import Furnishing, Habits, _plain_chair, _Top
from qs3.generation.scenes import prism, rectangle
from qs3.meshes.mesh import Mesh, MeshItem, merge

SEEDS = st.integers(0, 10_000)


def box(width, depth, height):
    """Its first four vertices are the lower corners of its back half, the step is lower."""
    half = np.array([width, depth]) / 2
    back = prism(rectangle(np.array([-half[0], 0.0]), half), 0.0, height)
    return merge([back, prism(rectangle(-half, np.array([half[0], 0.0])), 0.0, height / 2)])


SIZES = {"chest": (0.8, 0.5, 0.7), "stool": (0.4, 0.4, 0.5), "cup": (0.1, 0.1, 0.15)}
ITEMS = [
    MeshItem(f"{cls}/train/{cls}_0", cls, "train", partial(box, *size), "")
    for cls, size in SIZES.items()
]


def furnish(seed, **habits):
    """A room of the items that have habits."""
    own = [item for item in ITEMS if item.cls in habits]
    law = Furnishing(habits=habits, things=(4, 9))
    return law.furnish(lambda rng: own[int(rng.integers(len(own)))], np.random.default_rng(seed))


def back_and_front(thing):
    """[2] middles of its back half and of its step, on the floor."""
    return thing.mesh.vertices[:8, :2].mean(axis=0), thing.mesh.vertices[8:, :2].mean(axis=0)


def overlap(a, b):
    """Whether two upright boxes [16, 3] share a place: no side of either parts them."""
    for corners in (a, b):
        for k in range(2):
            side = corners[k + 1, :2] - corners[k, :2]
            one, other = (each[:, :2] @ side for each in (a, b))
            if one.max() <= other.min() or other.max() <= one.min():
                return False
    return True


@given(seed=SEEDS)
def test_things_are_in_the_room_and_apart(seed):
    room = furnish(seed, chest="wall", stool="floor")
    assert room.things
    corners = [thing.mesh.vertices for thing in room.things]
    for one in corners:
        assert (one[:, :2] > -0.05).all()
        assert (one[:, :2] < room.size_m + 0.05).all()
        assert one[:, 2].min() == 0
    for i, one in enumerate(corners):
        for other in corners[:i]:
            shrunk = one * 0.9 + one.mean(axis=0) * 0.1  # the map of the floor has cells of 5 cm
            assert not overlap(shrunk, other)


@given(seed=SEEDS)
def test_what_stands_at_a_wall_has_its_back_there(seed):
    room = furnish(seed, chest="wall")
    at_wall = 0
    for thing in room.things:
        back, front = back_and_front(thing)
        gaps = [np.minimum(place, room.size_m - place) for place in (back, front)]
        wall = int(np.argmin(gaps[0]))
        at_wall += gaps[0][wall] < 0.25 + 0.08 / 2 and gaps[0][wall] < gaps[1][wall]
    assert at_wall >= len(room.things) - 2  # where walls are full, it stands elsewhere


@given(seed=SEEDS)
def test_what_is_drawn_up_to_a_table_faces_it(seed):
    room = furnish(seed, stool=Habits(table=1.0))
    boards = [mesh for mesh in room.others if 0.7 <= mesh.bounds[1, 2] <= 0.78]
    facing = 0
    for thing in room.things:
        back, front = back_and_front(thing)
        middles = np.stack([board.bounds.mean(axis=0)[:2] for board in boards])
        nearest = middles[np.linalg.norm(middles - front, axis=1).argmin()]
        facing += np.linalg.norm(front - nearest) < np.linalg.norm(back - nearest)
    assert facing >= len(room.things) - 5  # a table has four sides; others stand anywhere
    assert facing or not room.things


@given(seed=SEEDS)
def test_what_stands_on_something_is_held_and_holds_a_place_of_its_own(seed):
    room = furnish(seed, chest="floor", cup="top")
    carriers = [t.mesh for t in room.things if t.cls == "chest"] + room.others
    cups = [thing.mesh.vertices for thing in room.things if thing.cls == "cup"]
    for k, cup in enumerate(cups):
        heights = [mesh.vertices[:, 2] for mesh in carriers]
        assert min(np.abs(z - cup[:, 2].min()).min() for z in heights) < 1e-3
        assert 0.35 <= cup[:, 2].min() <= 1.45
        for other in cups[:k]:
            apart = abs(cup[:, 2].min() - other[:, 2].min()) > 0.15
            assert apart or not overlap(cup, other)


@given(seed=SEEDS)
def test_what_hangs_is_at_a_wall_above_the_floor(seed):
    room = furnish(seed, chest=Habits(hung=1.0))
    for thing in room.things:
        assert 1.2 <= thing.mesh.bounds[0, 2] <= 1.5
        back, _ = back_and_front(thing)
        assert np.minimum(back, room.size_m - back).min() < 0.3


@settings(max_examples=40)
@given(seed=SEEDS)
def test_what_has_no_class_stands_on_flat_places(seed):
    """A top of 1.2 x 0.8 m, 70 cm high, with a wall of 20 cm along one side."""
    low, high, back = np.array([[-0.6, -0.4], [0.6, 0.4], [-0.6, 0.36]])
    top = merge([prism(rectangle(low, high), 0, 0.7), prism(rectangle(back, high), 0.7, 0.9)])
    rng = np.random.default_rng(seed)
    things = _Top.of(top, rng, 6).things(rng, (0.06, 0.3))
    assert len(things) <= 6
    for thing in things:
        low, high = thing.bounds
        assert low[2] == pytest.approx(0.7, abs=2e-4)
        assert 0.06 <= high[2] - low[2] <= 0.3
        # Its whole foot is on the top, but for half a cell of the grid.
        assert (low[:2] > [-0.6 - 0.05, -0.4 - 0.05]).all()
        assert (high[:2] < [0.6 + 0.05, 0.36 + 0.05]).all()
        assert trimesh.Trimesh(thing.vertices, thing.faces).is_volume


def test_nothing_stands_on_a_slope():
    roof, rng = trimesh.creation.cone(radius=1.0, height=1.0), np.random.default_rng(0)
    slope = Mesh(np.asarray(roof.vertices), np.asarray(roof.faces))
    assert not any(_Top.of(slope, rng, 3).things(rng, (0.06, 0.1)) for _ in range(10))


@given(seed=SEEDS)
def test_a_chair_without_a_class_has_a_seat_and_its_back_behind_it(seed):
    chair = _plain_chair(np.random.default_rng(seed))
    seat, back = chair.vertices[:8], chair.vertices[-8:]
    assert chair.bounds[0, 2] == 0
    assert 0.42 <= seat[:, 2].max() <= 0.5 < 0.75 <= back[:, 2].max() <= 1.05
    assert back[:, 0].max() < 0 == pytest.approx(seat[:, :2].mean())
    assert trimesh.Trimesh(chair.vertices, chair.faces).is_volume


def test_habits_are_drawn_as_often_as_they_are_likely():
    habits, rng = Habits(wall=0.5, top=0.3), np.random.default_rng(0)
    drawn = [habits.draw(rng) for _ in range(4000)]
    shares = {how: drawn.count(how) / 4000 for how in ("wall", "table", "top", "hung", "floor")}
    assert shares == pytest.approx(
        {"wall": 0.5, "table": 0, "top": 0.3, "hung": 0, "floor": 0.2}, abs=0.03
    )


def test_a_class_without_habits_has_the_default_ones():
    law = Furnishing(habits={"default": "top", "chest": "wall"})
    assert (law.of("cup").top, law.of("chest").wall, Furnishing().of("cup")) == (1, 1, Habits())


@settings(max_examples=5)
@given(seed=SEEDS)
def test_rooms_of_the_catalogue_are_full(seed):
    items = Catalogue(seed=1, train=2, test=0).items()
    rng = np.random.default_rng(seed)
    room = Furnishing(things=(25, 25)).furnish(lambda r: items[int(r.integers(20))], rng)
    assert len(room.things) >= 4
    assert all(np.isfinite(mesh.vertices).all() for mesh in room.others)
