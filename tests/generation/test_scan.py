"""Meshes from memory, and what a file leaves out on its way into a dataset."""

import numpy as np
import pytest
import trimesh

import qs3
from qs3.errors import ConfigError, DataError, MeshError
from qs3.generation.command import generate
from qs3.meshes.io import load_mesh
from qs3.store.meta import read_manifest
from qs3.store.store import open_pointset
from tests.generation.generating import QUICK, config

WORDS = ("domain=specklenet10", *QUICK)
BOX = trimesh.creation.box((0.5, 0.5, 0.75))  # exact in float32, as PLY has it


def test_from_memory_as_from_a_file(finished, meshes):
    """The same bytes as generate.py's, by the same id."""
    folder, made = finished
    files = {name: meshes / f"{name}.ply" for name in made.ids[:2]}
    clean = open_pointset(folder, "points_clean").points
    scans = qs3.generate({name: trimesh.load(file) for name, file in files.items()}, *WORDS)
    assert list(scans) == list(files)
    rows = read_manifest(folder)
    for index, (name, scan) in enumerate(scans.items()):
        np.testing.assert_array_equal(scan.points, made.points[index])
        np.testing.assert_array_equal(scan.clean, clean[index])
        assert scan.points.dtype == np.float32
        assert (scan.id, scan.views) == (name, rows[index].views)
        assert scan.valid_points == rows[index].valid_points
        assert len(scan.frames) == 2
        assert len(repr(scan)) < 120


def test_one_mesh_a_list_and_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("domain=modelnet10", "recipe.points=64")
    one = qs3.generate(BOX, *words)
    assert one.points.shape == (64, 3)
    assert (one.id, one.clean, one.views, one.frames) == ("object", None, 0, ())
    listed = qs3.generate([BOX, trimesh.Scene(BOX)], *words)
    assert [scan.id for scan in listed] == ["0", "1"]
    named = qs3.generate({"0": load_mesh(_saved(tmp_path)), "object": BOX}, *words)
    np.testing.assert_array_equal(listed[0].points, named["0"].points)
    np.testing.assert_array_equal(one.points, named["object"].points)
    assert not np.array_equal(one.points, qs3.generate(BOX, *words, "seed=1").points)
    assert [path.name for path in tmp_path.iterdir()] == ["box.ply"]  # nothing was written


def _saved(folder):
    BOX.export(folder / "box.ply")
    return folder / "box.ply"


@pytest.mark.parametrize(
    ("solid", "words", "error", "reason"),
    [
        (trimesh.Trimesh(), [], MeshError, "^object: "),
        (BOX, ["recipe.min_points=9999999"], DataError, "^object: "),
        (BOX, ["domain=scannet10"], ConfigError, "scannet10"),
    ],
)
def test_what_cannot_be_scanned(solid, words, error, reason):
    with pytest.raises(error, match=reason):
        qs3.generate(solid, *WORDS, *words)


def test_colliders_of_files_are_counted_in_the_manifest(tmp_path):
    """A dataset is the same bytes with and without them, unless they are kept."""
    bare, hidden = trimesh.Scene(), trimesh.Scene()
    for scene in (bare, hidden):
        scene.add_geometry(BOX, node_name="chair")
    hidden.add_geometry(trimesh.creation.box((2, 2, 2)), node_name="chair_collider")
    made = {}
    for name, scene, words in [
        ("bare", bare, []),
        ("hidden", hidden, []),
        ("kept", hidden, ["colliders=keep"]),
    ]:
        path = tmp_path / name / "meshes" / "chair" / "train" / "a.glb"
        path.parent.mkdir(parents=True)
        path.write_bytes(scene.export(file_type="glb"))
        settings = ["classes=[chair]", "workers=0", *words]
        cfg = config(tmp_path / name, path.parents[2], *settings, domain="modelnet10")
        made[name] = generate(cfg)
    rows = {name: read_manifest(tmp_path / name / "modelnet10")[0] for name, data in made.items()}
    assert made["bare"].sha256 == made["hidden"].sha256 != made["kept"].sha256
    assert rows["bare"].mesh_sha256 == rows["hidden"].mesh_sha256
    assert [row.reason for row in rows.values()] == ["", "colliders left out: 1", ""]
    assert {row.status for row in rows.values()} == {"ok"}
