"""Meshes whose files do not say which axis is up: given, judged, and where nothing tells."""

import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import qs3
from qs3.data.inspection.gravity import UPS, catalogue_model
from qs3.data.inspection.open_dataset import open_named
from qs3.data.inspection.surface import distance_to_mesh, surfaces_of
from qs3.errors import ConfigError
from qs3.generation.checks import check
from qs3.generation.command import generate
from qs3.generation.objects import mesh_items
from qs3.generation.up_axis import Evidence, _said, evidence, up_direction, with_up_axis
from qs3.meshes.catalogue import Catalogue
from qs3.meshes.folder import MeshFolder
from tests.generation.generating import composed, config

CLASSES = ("chair", "lamp", "table")
QUICK = ("workers=0", "recipe.points=512")


def y_up(mesh):
    """The vertices as most editors write them, (x, y, z) -> (x, z, -y)."""
    return mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]


def write(root, lying=CLASSES, suffix="obj"):
    """Four objects of each class of the catalogue, y up in the files of the classes of `lying`."""
    for item in Catalogue(seed=5, train=4, test=0, classes=CLASSES).items():
        mesh = item.load()
        vertices = y_up(mesh) if item.cls in lying else mesh.vertices
        path = root / f"{item.id}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(path)
    return root


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("meshes")
    return {"y": write(root / "y"), "z": write(root / "z", lying=())}


@pytest.fixture(scope="module")
def made(folders, tmp_path_factory):
    """M of both folders, by what was said of up: the dataset and its folder."""
    found = {}
    for folder, up in (("z", "auto"), ("y", "auto"), ("y", "y"), ("y", "z")):
        data_dir = tmp_path_factory.mktemp(f"{folder}_{up}")
        cfg = config(data_dir, folders[folder], f"up={up}", *QUICK, domain="modelnet10")
        found[folder, up] = generate(cfg), data_dir / "modelnet10"
    return found


@pytest.mark.parametrize("up", ["auto", "y"])
def test_meshes_with_y_up_stand_upright_and_are_those_with_z_up(made, up):
    (data, _), (straight, _) = made["y", up], made["z", "auto"]
    assert data.ids == straight.ids
    np.testing.assert_allclose(data.points, straight.points, atol=1e-6)
    assert data.meta["config"]["up"] == data.meta["settings"]["up"] == "y"
    assert straight.meta["config"]["up"] == "z"
    assert straight.meta["settings"]["up"] == "z"


def test_said_to_have_z_up_they_lie(made):
    for (data, _), lies in ((made["y", "z"], True), (made["y", "auto"], False)):
        for cls in CLASSES:
            verdict = catalogue_model().judge(data.points[data.members(cls)], cls)
            assert (verdict.lies, verdict.stands) == (lies, not lies), verdict


def test_the_surfaces_of_turned_meshes_are_found_again(made, folders):
    data, folder = made["y", "auto"]
    surfaces, why = surfaces_of(dict(data.meta), folders["y"])
    mesh = surfaces.mesh(open_named(str(folder), {}).kept[0])
    assert mesh is not None, why
    assert distance_to_mesh(data.points[0], mesh, np.random.default_rng(0)).max() < 1e-4


def test_the_surfaces_of_other_classes_are_found_again(folders, tmp_path):
    """A folder of brackets and valves was asked for bathtubs."""
    root = tmp_path / "parts"
    for ours, cls in (("bracket", "chair"), ("valve", "lamp")):
        shutil.copytree(folders["z"] / cls, root / ours)
    words = ("+domain.classes=[bracket,valve]", "domain.expected_counts=null", "classes=null")
    cfg = config(tmp_path / "data", root, *words, "up=z", *QUICK, domain="modelnet10")
    data = generate(cfg)
    surfaces, why = surfaces_of(dict(data.meta), root)
    row = open_named(str(tmp_path / "data" / "modelnet10"), {}).kept[0]
    assert row.cls == "bracket"
    assert surfaces.mesh(row) is not None, why


def test_scans_of_meshes_with_y_up_are_those_with_z_up(folders):
    """Through renderer and sensor, from memory."""
    words = ("domain=specklenet10", "sensor=speckle_stereo_small", "renderer=mitsuba", "views=1")
    words += ("renderer.samples=2",)
    mesh = MeshFolder(folders["z"], classes=("chair",)).items()[0].load()
    scan = qs3.generate(replace(mesh, vertices=y_up(mesh)), *words, "up=y")
    np.testing.assert_allclose(scan.points, qs3.generate(mesh, *words).points, atol=1e-5)


def judged(root, caplog, *words):
    """The axis that is taken, and what was said."""
    cfg = config("unused", root, *words, domain="modelnet10")
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="qs3"):
        axis = with_up_axis(cfg).up
    return axis, caplog.text


def test_the_evidence_is_said_and_does_not_depend_on_how_many_are_scanned(folders, caplog):
    for words in ((), ("limit=1",), ("half=second", "fraction=0.1")):
        axis, text = judged(folders["y"], caplog, *words)
        assert axis == "y"
        assert "y is up, by the shapes of 12 meshes" in text
        assert "chair 0 of 4" in text
        assert "WARNING" not in text


def test_shapes_that_do_not_tell_are_unknown(tmp_path, caplog):
    (tmp_path / "chair").mkdir()
    for i in range(5):
        trimesh.creation.icosphere(3, 0.3 + 0.1 * i).export(tmp_path / f"chair/{i}.obj")
    axis, text = judged(tmp_path, caplog, "classes=[chair]")
    assert axis == "z"
    assert "WARNING" in text
    assert "unknown" in text
    assert "Say up=z or up=y" in text


def test_classes_that_disagree_are_named(tmp_path, caplog):
    axis, text = judged(write(tmp_path, lying=("lamp",)), caplog)
    assert axis == "z"
    assert "the shapes of lamp say +y is up, not z" in text
    assert "classes=[lamp] up=y" in text


def test_directions_that_up_cannot_say_are_not_advised(caplog):
    """Chairs on their heads and lamps along x among tables that stand: only turning helps."""
    found = {cls: np.zeros((12, 6)) for cls in CLASSES}
    for cls, direction in zip(CLASSES, ("-z", "+x", "+z"), strict=True):
        found[cls][:, UPS.index(direction)] = 1
    found["table"] = np.tile(found["table"], (4, 1))
    assert _said(Evidence(found, 72)) == "z"
    assert "the shapes of chair say -z is up, not z: they are scanned upside down." in caplog.text
    assert "the shapes of lamp say +x is up, not z: they are scanned lying." in caplog.text
    assert caplog.text.count("Turn its files") == 2
    assert "classes=" not in caplog.text


def test_files_that_say_which_axis_is_up_are_not_asked(tmp_path, caplog):
    """The standard of glTF is y up, and the reader turns it whatever `up` says."""
    root = write(tmp_path, suffix="glb")
    assert judged(root, caplog) == ("z", "")
    words = ("classes=[chair]", "limit=1")
    given, plain = (
        mesh_items(config("unused", root, f"up={up}", *words, domain="modelnet10"))[0].load()
        for up in ("y", "z")
    )
    assert given.sha256 == plain.sha256


def test_another_direction_is_neither():
    """Scores of twelve meshes that all prefer one direction, and of such that prefer none."""
    scores = np.zeros((12, 6))
    assert up_direction(scores) is None
    for column, direction in ((5, "-y"), (0, "+z"), (4, "+y")):
        scores[:] = 0
        scores[:, column] = 1
        assert up_direction(scores) == direction
    assert up_direction(scores[:1] * 0.5) is None  # one mesh does not make it certain


def test_a_damaged_file_is_passed_over(tmp_path):
    root = write(tmp_path)
    (root / "chair/train/broken.obj").write_text("f 1 2 3\n")
    assert len(evidence(MeshFolder(root, classes=CLASSES).items()).scores["chair"]) == 4


def test_wrong_words():
    with pytest.raises(ConfigError, match="up must be one of"):
        check(composed("domain=modelnet10", "up=x"))
    with pytest.raises(ConfigError, match="meshes=PATH"):
        mesh_items(composed("domain=modelnet10", "up=y"))


def test_copies_of_a_mesh_count_once(folders, tmp_path):
    """Sixty files of one shape are one opinion."""
    one = next(iter(sorted((folders["y"] / "chair").rglob("*.obj"))))
    for i in range(60):
        copy = tmp_path / "chair" / "train" / f"copy_{i}.obj"
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(one.read_bytes())
    found = evidence(MeshFolder(tmp_path, classes=("chair",)).items())
    assert found.silent == 60
    assert len(found.scores["chair"]) == 1
