"""Beds, bathtubs, cabinets and bookshelves: closed, standing, of real size, always the same."""

from importlib import import_module

import numpy as np
import pytest
import trimesh

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.mesh import merge

# metres: lowest and highest (longer side, shorter side, height) with doors and drawers open
SIZES = {
    "bed": ((1.15, 0.6, 0.1), (2.9, 2.7, 2.4)),
    "bathtub": ((0.75, 0.64, 0.4), (2.3, 1.8, 2.1)),
    "cabinet": ((0.38, 0.3, 0.3), (2.7, 1.9, 2.5)),
    "bookshelf": ((0.3, 0.16, 0.2), (3.0, 1.3, 2.6)),
}
SEEDS = range(6)
FAMILIES = [
    (cls, f) for cls in SIZES for f in import_module(f"qs3.meshes.catalogue.{cls}").FAMILIES
]
every_family = pytest.mark.parametrize(
    ("cls", "family"), FAMILIES, ids=[f"{cls}-{f.name}" for cls, f in FAMILIES]
)


@pytest.mark.parametrize("cls", SIZES)
def test_both_splits_have_families_and_names_are_unique(cls):
    found = [f for owner, f in FAMILIES if owner == cls]
    assert len(found) >= 6
    assert len({f.name for f in found}) == len(found)
    assert all(sum(f.split == split for f in found) >= 2 for split in ("train", "test"))


@every_family
def test_parts_are_solids_on_the_floor(cls, family):
    for seed in SEEDS:
        parts = family.build(Draw(f"{cls}/{seed}"))
        for part in parts:
            solid = trimesh.Trimesh(part.vertices, part.faces, process=False)
            assert solid.is_watertight
            assert solid.is_winding_consistent
            assert solid.volume > 0
        whole = merge(parts)
        assert abs(whole.bounds[0, 2]) < 1e-9
        assert len(whole.faces) < 20_000


@every_family
def test_sizes_are_those_of_furniture(cls, family):
    low, high = SIZES[cls]
    for seed in SEEDS:
        width, depth, height = np.ptp(merge(family.build(Draw(f"{cls}/{seed}"))).bounds, axis=0)
        size = np.array([max(width, depth), min(width, depth), height])
        assert (size >= low).all(), size
        assert (size <= high).all(), size


@every_family
def test_equal_keys_give_equal_bytes_and_others_do_not(cls, family):
    meshes = [merge(family.build(Draw(key))) for key in ("a", "a", "b")]
    assert meshes[0].sha256 == meshes[1].sha256
    assert meshes[0].sha256 != meshes[2].sha256


def wall_m(tub, z, directions=32):
    """Least thickness of the wall at a height; negative where the inside has come outside."""
    solid = trimesh.Trimesh(tub.vertices, tub.faces, process=False)
    cut, face = trimesh.intersections.mesh_plane(solid, (0, 0, 1), (0, 0, z), return_faces=True)
    normals = solid.face_normals[face][:, :2]
    p, q = cut[:, 0, :2], cut[:, 1, :2]
    centre = (p.min(axis=0) + p.max(axis=0)) / 2
    least = np.inf
    for angle in 0.01 + np.arange(directions) * (2 * np.pi / directions):
        ray, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        u, v = (p - centre) @ across, (q - centre) @ across
        hit = (u <= 0) != (v <= 0)
        t = (u / np.where(hit, u - v, 1.0))[:, None]
        radius = (p + t * (q - p) - centre) @ ray
        outside, hit = normals @ ray > 0, hit & (radius > 0)
        least = min(least, radius[hit & outside].max() - radius[hit & ~outside].min())
    return least


@pytest.mark.parametrize(
    "family", [f for cls, f in FAMILIES if cls == "bathtub"], ids=lambda f: f.name
)
def test_tubs_are_hollow_and_their_walls_have_a_thickness(family):
    for seed in SEEDS:
        tub = family.build(Draw(f"hollow/{seed}"))[0]
        solid = trimesh.Trimesh(tub.vertices, tub.faces, process=False)
        assert solid.volume < 0.75 * solid.convex_hull.volume
        low, high = tub.bounds[:, 2]
        for share in (0.3, 0.45, 0.6):
            assert wall_m(tub, low + share * (high - low)) > 0.008
