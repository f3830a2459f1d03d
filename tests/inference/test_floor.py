"""Where the floor is, by the lowest points of many objects; and when that is not believed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from qs3.datasets.arrays import named_arrays
from qs3.errors import ConfigError
from qs3.inference import pretrained
from qs3.inference.floor import CAMERA_M, FEWEST, check_camera_height, check_floor, floor_under
from qs3.inference.settings import Settings


def boxes(ends, seed=0):
    """Objects half a metre high whose lowest points lie at `ends`."""
    rng = np.random.default_rng(seed)
    return [rng.random((400, 3)) * [1, 1, 0.5] + [0, 2, end] for end in ends]


def test_the_floor_is_where_many_end_and_none_goes_below():
    camera = 1.32
    on_it = boxes([-camera] * 40)
    raised = boxes(np.linspace(-camera + 0.3, 0.4, 60), seed=1)  # on tables, cut off, hidden
    found = floor_under([*on_it, *raised])
    assert found.z == pytest.approx(-camera, abs=0.03)
    assert "by the lowest points of 100 objects (" in found.words
    assert floor_under([*raised, *on_it]).z == found.z
    stray = [np.vstack([cloud, [[0, 2, -9.0]]]) for cloud in on_it]  # behind edges of depth
    assert floor_under([*stray, *raised]).z == pytest.approx(found.z, abs=0.02)
    through = boxes([-camera - 0.7], seed=2)  # in a mirror
    assert floor_under([*on_it, *raised, *through]).z == pytest.approx(found.z, abs=0.02)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (0, "if it is not known, leave it out"),
        (-1.2, "measured from the floor up; 1.2?"),
        (1250, "if these are millimetres, give 1.25"),
        (125.0, "if these are centimetres, give 1.25"),
        (np.nan, "camera_height must be a finite number, got nan"),
        (np.inf, "camera_height must be a finite number, got inf"),
        ("1.2", "camera_height must be a number"),
    ],
)
def test_a_height_that_is_none_says_what_may_be_meant(given, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        check_camera_height(given)


def test_heights_that_cameras_have_pass():
    assert [check_camera_height(one) for one in (0.05, 1.25, 29.9)] == [0.05, 1.25, 29.9]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            -1180,
            "floor=-1180 is not where a floor is in metres: if these are millimetres, give -1.",
        ),
        (1180, "if these are millimetres, give 1.18"),
        (-118.0, "if these are centimetres, give -1.18"),
        (np.inf, "floor must be a finite number, got inf"),
        (True, "floor must be a number"),
    ],
)
def test_a_floor_in_another_unit_is_refused(given, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        check_floor(given)
    if not isinstance(given, bool):
        with pytest.raises(ConfigError, match=re.escape(said)):
            Settings(input="scans", floor=given)


def test_floors_above_and_below_the_origin_pass():
    assert [check_floor(one) for one in (-29.9, -1.18, 0, 2.5)] == [-29.9, -1.18, 0, 2.5]


@pytest.mark.parametrize("camera", [1.1, 1.4, 1.7])
def test_it_is_found_under_room_scans(camera):
    """Of furniture that stands on the floor and on tables, seen in part: their floor is z = 0."""
    sample = named_arrays(pretrained.FOLDER / "source_sample.npz")["points"]
    clouds = sample.astype(np.float64) - [0, 0, camera]
    assert floor_under(clouds).z == pytest.approx(-camera, abs=0.05)


def test_cameras_of_several_heights_have_one_floor_in_common():
    """Within what training moves clouds up and down (`protocol.augment.lift`)."""
    sample = named_arrays(pretrained.FOLDER / "source_sample.npz")["points"].astype(np.float64)
    heights = np.random.default_rng(0).uniform(1.2, 1.5, len(sample))
    clouds = [cloud - [0, 0, height] for cloud, height in zip(sample, heights, strict=True)]
    assert floor_under(clouds).z == pytest.approx(-1.35, abs=0.2)


@pytest.mark.parametrize(
    ("ends", "why"),
    [
        ([-1.3] * (FEWEST - 1), "29 objects are too few"),
        ([-0.6] * 60, "a camera 0.6 m above the floor is not what"),  # all of them on desks
        ([-2.6] * 60, "a camera 2.6 m above the floor is not what"),
        ([0.0] * 60, "a camera"),  # the floor, or the objects' own middle, is the origin
        (np.linspace(-9, 9, 200), "have no common lower edge"),
        ([-1.3] * 90 + [-1.9] * 5, "have no common lower edge"),
    ],
)
def test_what_is_not_believed(ends, why):
    found = floor_under(boxes(ends))
    assert found.z is None
    assert why in found.words


def test_the_range_is_that_of_the_cameras_that_were_learnt_from():
    from tests.composing import compose

    camera = compose("generate", ["domain=roomscan10"]).recipe.camera
    assert camera.min_height_m - 0.1 == pytest.approx(CAMERA_M[0])
    assert camera.max_height_m + 0.1 == pytest.approx(CAMERA_M[1])
