"""The same object in every condition that meshes come in, through generate.py."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from qs3.generation.command import generate
from qs3.generation.plan import planned
from qs3.store.store import open_pointset
from qs3.utils.files import sha256_file
from tests.generation.generating import config


def stool():
    """A seat, a back and four legs: no symmetry, metres, z up, watertight parts."""
    parts = [trimesh.creation.box((0.5, 0.45, 0.06)), trimesh.creation.box((0.5, 0.04, 0.45))]
    parts[0].apply_translation((0, 0, 0.45))
    parts[1].apply_translation((0, 0.2, 0.7))
    for x in (-0.2, 0.2):
        for y in (-0.17, 0.17):
            leg = trimesh.creation.cylinder(0.03, 0.42)
            leg.apply_translation((x, y, 0.21))
            parts.append(leg)
    return trimesh.util.concatenate(parts)


def faces_changed(change):
    return lambda solid: trimesh.Trimesh(solid.vertices, change(solid.faces), process=False)


def with_fin(solid):
    """An edge of the seat that three faces share: no manifold, and nearly no area."""
    n = len(solid.vertices)
    a, b = solid.faces[0, :2]
    middle = (solid.vertices[a] + solid.vertices[b]) / 2 + (0, 0, 1e-4)
    return trimesh.Trimesh(
        np.vstack([solid.vertices, middle]), np.vstack([solid.faces, [[a, b, n]]]), process=False
    )


def soup(solid):
    corners = solid.vertices[solid.faces].reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


SAME = {  # what must give the same cloud as the plain OFF
    "millimetres": lambda solid: solid.apply_scale(1000.0),
    "inverted": faces_changed(lambda f: f[:, ::-1]),
    "duplicate_faces": faces_changed(lambda f: np.concatenate([f, f[::-1]])),
    "degenerate_faces": faces_changed(lambda f: np.concatenate([f, f[:9, [0, 0, 1]]])),
    "soup_without_normals": soup,
    "non_manifold": with_fin,
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    root = tmp_path_factory.mktemp("plain")
    return scan(root, lambda solid: solid)


def scan(root, change):
    folder = root / "meshes" / "chair" / "train"
    folder.mkdir(parents=True)
    change(stool()).export(folder / "stool.off", digits=9)
    generate(config(root, root / "meshes", "classes=[chair]", "workers=0"))
    noisy = open_pointset(root / "specklenet10")
    assert noisy.ids == ("chair/train/stool",)
    return noisy.points[0], open_pointset(root / "specklenet10", "points_clean").points[0]


def gap(a, b):
    """The 99th percentile of the distance from points of one cloud to the other, both ways."""
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return np.percentile(np.concatenate([there, back]), 99)


QUICK = ("inverted", "duplicate_faces")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in SAME]
)
def test_the_same_object_gives_the_same_cloud(plain, tmp_path, name):
    """The id is the same, so are yaw, poses and noise: what differs is rounding."""
    noisy, clean = scan(tmp_path, SAME[name])
    assert gap(noisy, plain[0]) < 1e-4
    assert gap(clean, plain[1]) < 1e-4
    np.testing.assert_allclose(clean.min(axis=0), plain[1].min(axis=0), atol=1e-3)
    np.testing.assert_allclose(clean.max(axis=0), plain[1].max(axis=0), atol=1e-3)


def test_vertices_in_a_file_beside_a_gltf_are_part_of_the_plan(tmp_path):
    folder = tmp_path / "chair" / "train"
    folder.mkdir(parents=True)
    for name, data in stool().export(file_type="gltf").items():
        (folder / name.replace("model", "a")).write_bytes(data)
    (folder / "b.glb").write_bytes(stool().export(file_type="glb"))

    def objects():
        return planned(config(tmp_path, tmp_path, "classes=[chair]")).describe({})["objects"]

    before = objects()
    beside = max(folder.glob("*.bin"))
    beside.write_bytes(beside.read_bytes()[::-1])
    assert [a == b for a, b in zip(before, objects(), strict=True)] == [False, True]
    assert before[1].endswith(sha256_file(folder / "b.glb")[:16])  # alone, as it always was
