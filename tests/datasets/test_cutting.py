"""What is cut equals what was placed: the core on single images whose every surface is known."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from qs3.datasets.cutting import Limits, Rules, body, cut, occlusion, pieces, rim
from qs3.datasets.depth_images import DepthImage, Pinhole, upright
from qs3.datasets.nyuv2 import AREA
from tests.fixtures.frame_files import Shot, Thing, kinect


def seen(shot, noisy=True):
    """The image of a shot, and what each pixel shows."""
    depth, shown = shot.render()
    depth = kinect(depth, 1) if noisy else depth
    return DepthImage(depth, Pinhole(*shot.camera), upright(shot.up_in_camera)), shown


def test_covered_and_cut_off(shots, rules):
    image, shown = seen(shots[1])
    sofa = cut(image, shown == 0, "sofa", rules)
    assert (sofa.tier, sofa.refused) == ("hard", False)
    assert "covered" in sofa.why
    assert 0.1 < sofa.occ < 0.5
    assert sofa.rim == 0
    toy = cut(image, shown == 1, "default", rules)
    assert toy.occ < 0.02  # what covers is not covered
    image, shown = seen(shots[2])
    image = dataclasses.replace(image, area=AREA)
    left, right = (cut(image, shown == index, "chair", rules) for index in (0, 1))
    assert right.refused
    assert "cut off by the picture" in right.why or "pixels" in right.why
    assert (left.refused, left.tier) == (False, "hard")
    assert "cut off" in left.why
    image, shown = seen(shots[0])
    clean = cut(image, shown == 0, "chair", rules)
    assert (clean.tier, clean.why, clean.rim) == ("clean", "", 0)
    assert clean.occ < 0.05


def test_an_arm_before_its_seat_is_joined_and_a_wall_behind_is_not(rules):
    depth = np.full((80, 120), 3.0)
    depth[20:60, 20:60] = 2.0  # a seat
    depth[20:60, 60:70] = 1.93  # an arm, 7 cm nearer: a jump, but near in space
    mask = np.zeros(depth.shape, bool)
    mask[20:60, 20:90] = True  # and twenty columns of wall
    image = DepthImage(depth, Pinhole(500, 500, 60, 40), np.array(LEVEL))
    kept = body(pieces(mask, depth, rules), image.points_m, rules)
    np.testing.assert_array_equal(kept, mask & (depth < 2.5))
    piece = cut(image, mask, "default", dataclasses.replace(rules, erode_px=0))
    assert piece.kept == pytest.approx(50 / 70)


@given(seed=st.integers(0, 10_000), full=st.floats(0.1, 1))
def test_pieces_are_those_of_a_graph(seed, full):
    """Twin: an edge for each two pixels that follow each other, and scipy's components."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(2, 30, 2)
    depth = 2 + np.cumsum(rng.normal(0, 0.03, (height, width)), axis=1)
    measured, rules = rng.random(depth.shape) < full, Rules()
    edges = []
    for lines, across in ((range(height), False), (range(width), True)):
        for line in lines:
            along = np.flatnonzero(measured[:, line] if across else measured[line])
            for a, b in itertools.pairwise(along):
                first, second = ((a, line), (b, line)) if across else ((line, a), (line, b))
                z = sorted((depth[first], depth[second]))
                if b - a <= rules.bridge_px + 1 and z[1] - z[0] <= max(0.05, 0.03 * z[0]):
                    edges.append([np.ravel_multi_index(at, depth.shape) for at in (first, second)])
    pairs = np.array(edges, dtype=int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(pairs.shape[1]), pairs), (depth.size, depth.size))
    _, label = connected_components(graph, directed=False)
    number = pieces(measured, depth, rules)
    np.testing.assert_array_equal(number >= 0, measured)
    own, theirs = number[measured], label.reshape(depth.shape)[measured]
    np.testing.assert_array_equal(own[:, None] == own, theirs[:, None] == theirs)
    assert (np.diff(np.bincount(own)) <= 0).all() if len(own) else True  # the largest first


LEVEL = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]


def test_a_hole_is_bridged_up_to_its_width(rules):
    depth = np.full((10, 60), 2.0)
    depth[:, 30:38] = 0
    measured = depth > 0
    assert pieces(measured, depth, rules).max() == 0
    depth[:, 38] = 0
    assert pieces(depth > 0, depth, rules).max() == 1


def test_rim_counts_the_outline_at_the_border():
    rules = Rules(border_px=1)
    inside = np.ones((20, 30), bool)
    mask = np.zeros((20, 30), bool)
    mask[0:10, 5:15] = True  # ten of 36 outline pixels lie in the first row
    assert rim(mask, inside, rules) == pytest.approx(10 / 36)
    inside[:5] = False
    moved = np.roll(mask, 5, axis=0)
    assert rim(moved, inside, rules) == pytest.approx(10 / 36)
    assert rim(np.roll(mask, 8, axis=0), np.ones_like(mask), rules) == 0


def test_occlusion_counts_the_outline_beside_something_nearer(rules):
    depth = np.full((40, 40), 3.0)
    mask = np.zeros((40, 40), bool)
    mask[10:30, 10:30] = True
    depth[mask] = 2.0
    depth[:, 30:] = 1.0  # all along its right side
    one = dataclasses.replace(rules, reach_px=1)
    assert occlusion(mask, mask, depth, one) == pytest.approx(20 / 76)
    depth[:, 30:] = 1.97  # no more than a jump
    assert occlusion(mask, mask, depth, one) == 0


def test_refusals_say_why(rules):
    shot = Shot([Thing("chair", 0, 2.4, 35)])
    image, shown = seen(shot)
    mask = shown == 0
    few = dataclasses.replace(rules, limits={"chair": Limits(pixels=10**6)})
    assert "fewer than 1000000" in cut(image, mask, "chair", few).why
    small = dataclasses.replace(rules, limits={"chair": Limits(1, 2.0, 3.0)})
    assert "m, not 2 to 3 m" in cut(image, mask, "chair", small).why
    blind = DepthImage(
        np.where(np.random.default_rng(0).random(mask.shape) < 0.7, 0, image.depth_m),
        image.camera, image.world_from_camera,
    )  # fmt: skip
    assert "without depth" in cut(blind, mask, "chair", rules).why
    nothing = cut(image, np.zeros_like(mask), "chair", rules)
    assert (nothing.refused, nothing.pixels) == (True, 0)


def test_outliers_are_flagged_or_dropped(rules):
    image, shown = seen(Shot([Thing("chair", 0, 2.4, 35)]))
    kept = cut(image, shown == 0, "chair", rules)
    dropped = cut(image, shown == 0, "chair", dataclasses.replace(rules, drop_outliers=True))
    assert 0.9 < kept.inlier.mean() < 1
    np.testing.assert_array_equal(dropped.points_m, kept.points_m[kept.inlier])
    assert dropped.pixels == kept.pixels


def test_a_camera_that_looks_straight_down_or_up_is_the_limit_of_one_that_nearly_does():
    for z in (-1.0, 1.0):
        exact = upright(np.array([0, 0, z]))
        np.testing.assert_allclose(exact, upright(np.array([0, -1e-5, z])), atol=1e-4)
        np.testing.assert_allclose(exact @ exact.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(exact) > 0
