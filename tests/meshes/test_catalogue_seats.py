"""Chairs, tables and sofas of the embedded catalogue."""

from importlib import import_module

import numpy as np
import pytest
import trimesh

from qs3.meshes.catalogue import families, make, make_parts
from qs3.meshes.mesh import merge

CLASSES = ("chair", "sofa", "table")
SEEDS = 6

# metres: lowest and highest plausible (width, depth, height)
SIZES = {
    "chair": ((0.30, 0.30, 0.55), (1.00, 1.05, 1.40)),
    "sofa": ((0.75, 0.50, 0.38), (3.40, 2.20, 1.15)),
    "table": ((0.30, 0.25, 0.30), (2.80, 2.00, 0.95)),
}
# where people sit, or what things stand on, as seen from above; metres above the floor
SURFACE = {"chair": (0.36, 0.90), "sofa": (0.34, 0.70), "table": (0.30, 0.95)}

OBJECTS = [(cls, family.name) for cls in CLASSES for family in families(cls)]


@pytest.mark.parametrize(("cls", "name"), OBJECTS)
def test_parts_are_watertight_outward_solids_on_the_floor(cls, name):
    low, high = SIZES[cls]
    for seed in range(SEEDS):
        parts = make_parts(cls, name, str(seed))
        for k, part in enumerate(parts):
            solid = trimesh.Trimesh(part.vertices, part.faces, process=False)
            where = f"{cls}/{name}, seed {seed}, part {k}"
            assert np.isfinite(part.vertices).all(), where
            assert solid.is_watertight, where
            assert solid.is_winding_consistent, where
            assert solid.volume > 0, where
            assert (solid.area_faces > 1e-10).all(), where
        whole = merge(parts)
        bounds = whole.bounds
        assert bounds[0, 2] == 0
        size = bounds[1] - bounds[0]
        assert (size >= low).all(), (seed, size)
        assert (size <= high).all(), (seed, size)
        assert len(whole.faces) < 8000


@pytest.mark.parametrize(("cls", "name"), OBJECTS)
def test_stands_on_more_than_one_point(cls, name):
    """The floor contact encloses the centre of mass, so the object would not tip over."""
    for seed in range(SEEDS):
        parts = make_parts(cls, name, str(seed))
        mesh = merge(parts)
        contact = mesh.vertices[mesh.vertices[:, 2] < 0.03, :2]
        solids = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
        weight = np.array([solid.volume for solid in solids])
        centre = (weight @ np.array([solid.center_mass for solid in solids]) / weight.sum())[:2]
        assert (contact.min(axis=0) < centre).all(), (seed, centre)
        assert (centre < contact.max(axis=0)).all(), (seed, centre)


@pytest.mark.parametrize(("cls", "name"), OBJECTS)
def test_all_parts_hang_together(cls, name):
    """No part floats: bounding boxes, grown by 1 cm, connect every part with every other."""
    for seed in range(SEEDS):
        parts = make_parts(cls, name, str(seed))
        low = np.array([part.bounds[0] for part in parts]) - 0.005
        high = np.array([part.bounds[1] for part in parts]) + 0.005
        touching = (low[:, None] <= high[None]).all(-1) & (low[None] <= high[:, None]).all(-1)
        reached = np.zeros(len(parts), dtype=bool)
        reached[0] = True
        for _ in parts:
            reached |= touching[reached].any(axis=0)
        assert reached.all(), (seed, np.flatnonzero(~reached))


@pytest.mark.parametrize("cls", CLASSES)
def test_level_surface_at_a_usable_height(cls):
    """Much of the area that faces up is where one sits or puts things down."""
    low, high = SURFACE[cls]
    for family in families(cls):
        for seed in range(SEEDS):
            mesh = make(cls, family.name, str(seed))
            a, b, c = mesh.vertices[mesh.faces.T]
            normal = np.cross(b - a, c - a) / 2
            height = (a + b + c)[:, 2] / 3
            level = (normal[:, 2] > 0.9 * np.linalg.norm(normal, axis=1)) & (height > low)
            area = normal[level & (height < high), 2].sum()
            assert area > 0.06, (family.name, seed, area)


@pytest.mark.parametrize(("cls", "name"), OBJECTS)
def test_same_key_same_bytes_other_key_other_object(cls, name):
    hashes = [make(cls, name, str(seed)).sha256 for seed in range(SEEDS)]
    assert hashes == [make(cls, name, str(seed)).sha256 for seed in range(SEEDS)]
    assert len(set(hashes)) == SEEDS


@pytest.mark.parametrize("cls", CLASSES)
def test_families_of_both_splits(cls):
    found = import_module(f"qs3.meshes.catalogue.{cls}").FAMILIES
    names = [family.name for family in found]
    assert len(set(names)) == len(names)
    train = sum(family.split == "train" for family in found)
    assert train >= 4
    assert len(found) - train >= 2
    assert 0.55 <= train / len(found) <= 0.8
