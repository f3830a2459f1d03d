"""Polygons to triangles: fans stay as they were, concave outlines are covered exactly once."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.meshes.io import load_mesh
from qs3.meshes.polygons import fan, triangulated
from tests.meshes.written import save

U = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
KEYHOLE = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
"""A square with a hole, joined by a slit of no width."""
TWO_HOLES = [
    *[(0, 0), (8, 0), (8, 4), (0, 4), (0, 0)],
    *[(1, 1), (1, 3), (3, 3), (3, 1), (5, 1), (5, 3), (7, 3), (7, 1), (5, 1), (3, 1), (1, 1)],
]
COLLINEAR = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2), (0, 1)]
DOUBLED = [p for p in U for _ in range(2)]


def area(outline):
    x, y = np.array(outline, float).T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def areas(points, faces):
    """Signed, of triangles in the plane."""
    a, b, c = np.array(points, float)[faces].transpose(1, 0, 2)
    return np.array([np.linalg.det([q - p, r - p]) / 2 for p, q, r in zip(a, b, c, strict=True)])


def cut(points, normal=(0.0, 0.0, 1.0), noise=0.0):
    """Triangles of one outline that lies in some plane, or nearly."""
    basis, _ = np.linalg.qr(np.column_stack([normal, np.eye(3)[:, :2]]))
    if np.linalg.det(basis) < 0:
        basis[:, 2] *= -1
    placed = np.array(points, float) @ basis[:, 1:].T + (5, 6, 7)
    _, which = np.unique(np.array(points, float), axis=0, return_inverse=True)
    placed += noise * np.random.default_rng(0).normal(size=placed.shape)[which.ravel()]
    return triangulated(placed, np.array([len(points)]), np.arange(len(points)))


@pytest.mark.parametrize(
    "outline",
    [U, KEYHOLE, TWO_HOLES, COLLINEAR, DOUBLED],
)
@pytest.mark.parametrize("backwards", [False, True])
def test_concave_outlines_are_covered_once_from_whichever_corner(outline, backwards):
    outline = outline[::-1] if backwards else outline
    whole = area(outline)
    for start in range(0, len(outline), 1 + len(outline) // 12):
        points = outline[start:] + outline[:start]
        for normal, noise in (((0.0, 0.0, 1.0), 0.0), ((0.5, -2.0, 1.0), 1e-6)):
            found = areas(points, cut(points, normal, noise))
            assert len(found) == len(points) - 2
            assert abs(found.sum() - whole) < 1e-9
            # All turned as the outline is: then none is outside, and none covers another.
            assert abs(np.abs(found).sum() - abs(whole)) < 1e-4


@st.composite
def stars(draw):
    """Simple polygons: corners in the order of their angles, seen from within."""
    count = draw(st.integers(4, 14))
    radii = draw(st.lists(st.floats(0.05, 1), min_size=count, max_size=count))
    return [
        (r * math.cos(2 * math.pi * i / count), r * math.sin(2 * math.pi * i / count))
        for i, r in enumerate(radii)
    ]


@settings(max_examples=60, deadline=None)
@given(outline=stars())
def test_any_star_is_covered_once(outline):
    found = areas(outline, cut(outline, (0.3, 0.4, -0.5)))
    assert abs(found.sum() - area(outline)) < 1e-9
    assert abs(np.abs(found).sum() - area(outline)) < 1e-5


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_convex_polygons_and_fans_that_are_right_stay(seed):
    """Many in one call, rounded to float32, with corners within sides and tilted ones."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 9, 200)
    points = []
    for size in sizes:
        angles = np.sort(rng.uniform(0, 2 * np.pi, size))
        round_ = np.stack([np.cos(angles), np.sin(angles), np.zeros(size)], axis=1)
        if size > 3:  # one corner within a side
            round_[1] = round_[0] + rng.uniform() * (round_[2] - round_[0])
        points.append(round_ @ rng.normal(size=(3, 3)) + rng.normal(size=3))
    vertices = np.concatenate(points).astype(np.float32).astype(np.float64)
    corners = np.arange(len(vertices))
    np.testing.assert_array_equal(triangulated(vertices, sizes, corners), fan(sizes, corners))
    seen_from_first = np.array([(0, 0, 0), (3, 0, 0), (1, 1, 0), (0, 3, 0)], float)  # concave
    assert triangulated(seen_from_first, np.array([4]), np.arange(4)).tolist() == [
        [0, 1, 2],
        [0, 2, 3],
    ]


@pytest.mark.parametrize(
    "outline",
    [
        [(0, 0), (2, 2), (2, 0), (0, 1)],  # two triangles that meet in a point
        [(0, 0), (4, 0), (4, 4), (2, -2), (0, 4)],
        [(0, 0), (1, 0), (2, 0), (1, 0)],
    ],
)
def test_what_crosses_itself_or_has_no_area_is_a_fan(outline):
    count = len(outline)
    assert cut(outline).tolist() == fan(np.array([count]), np.arange(count)).tolist()


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_a_concave_face_of_a_file(tmp_path, suffix):
    for start in range(8):
        points = U[start:] + U[:start]
        lines = [f"{x} 5 {y}" for x, y in points]
        each = " ".join(map(str, range(8)))
        text = {
            "obj": "".join(f"v {line}\n" for line in lines) + "f 1 2 3 4 5 6 7 8\n",
            "off": "OFF\n8 1 0\n" + "\n".join(lines) + f"\n8 {each}\n",
            "ply": "ply\nformat ascii 1.0\nelement face 1\nproperty list int int vertex_indices\n"
            "element vertex 8\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
            f"8 {each}\n" + "\n".join(lines) + "\n",
        }[suffix]
        mesh = load_mesh(save(tmp_path, f"a.{suffix}", text))
        one, two = (
            mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, 0]] for i in (1, 2)
        )
        each = np.linalg.norm(np.cross(one, two), axis=1) / 2
        assert len(each) == 6
        assert abs(each.sum() - 7) < 1e-6
