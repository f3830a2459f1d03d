"""materials=own: what mesh files say they are made of, in the pictures and in the plan."""

import csv
import pickle

import numpy as np
import pytest

import qs3
from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.generation.command import generate
from qs3.generation.materials import INFRARED_ALBEDO, surface_of
from qs3.generation.objects import mesh_items
from qs3.generation.plan import describe
from qs3.generation.travel import sent
from qs3.geometry.cameras import Camera, Intrinsics, look_at
from qs3.meshes.finishes import Finish, linear
from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import UnitCube
from qs3.sensors.renderers.base import Body, Projector, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.gloss import times_pi
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import QUICK, composed, config
from tests.meshes.coloured import MTL, glb, obj, ply
from tests.meshes.written import SQUARE_OFF, save

OWN, MIXED = (
    build(composed("domain=specklenet10", f"materials={name}").materials)
    for name in ("own", "mixed")
)
ALBEDOS = (0.2, 0.8)
"""Of the two plates: the brightest channels of their colours."""


def dressed(mesh, which=OWN, seed=0):
    return which.dress((Body(mesh),), np.random.default_rng(seed))


# --- the guess


# Reflectances at 450, 550 and 650 nm and at 850 nm: USGS Spectral Library 7, GDS363, 437, 430, 431,
# 433, 436, 338 and 336, and ECOSTRESS 0833UUURBR, as conf/materials/mixed.yaml names them.
SPECTRA = {
    "pine": ((0.22, 0.33, 0.46), 0.63),
    "white cotton": ((0.63, 0.60, 0.62), 0.64),
    "burlap": ((0.07, 0.15, 0.21), 0.53),
    "red nylon": ((0.04, 0.03, 0.49), 0.53),
    "blue nylon": ((0.46, 0.11, 0.07), 0.64),
    "black nylon": ((0.14, 0.13, 0.13), 0.35),
    "white PVC": ((0.61, 0.66, 0.69), 0.70),
    "green fibreglass": ((0.17, 0.28, 0.06), 0.34),
    "black rubber": ((0.06, 0.06, 0.06), 0.06),
}


def test_the_brightest_channel_is_nearer_to_measured_infrared_than_luminance_is():
    errors = []
    for visible, infrared in SPECTRA.values():
        blue, green, red = visible
        guess, _ = surface_of(Finish((red, green, blue)))
        luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        errors.append([abs(guess - infrared), abs(luminance - infrared)])
        assert guess <= infrared + 0.01  # it is a lower bound
    ours, theirs = np.mean(errors, axis=0)
    assert ours == pytest.approx(0.11, abs=0.005)
    assert theirs == pytest.approx(0.22, abs=0.005)


def test_guesses_stay_within_their_range():
    for colour, albedo in zip(((0, 0, 0), (1, 0, 0)), INFRARED_ALBEDO, strict=True):
        found, gloss = surface_of(Finish(colour, roughness=0.0, specular=1.0, clear=1.0))
        assert found == albedo
        assert (gloss.roughness, gloss.specular, gloss.transmission) == (0.1, 1.0, 0.95)


# --- dressing


@pytest.mark.parametrize("name", ["a.glb", "a.obj", "a.ply"])
def test_each_plate_has_what_its_file_says(name, tmp_path):
    save(tmp_path, "plates.mtl", MTL)
    bright = float(linear(np.array(200 / 255)))
    made = {"a.glb": glb(), "a.obj": obj(), "a.ply": ply(colours=((0, 0, 90), (200, 10, 10)))}
    path = save(tmp_path, name, made[name])
    found = {
        np.sign(body.mesh.bounds.mean(axis=0)[0]): body
        for body in dressed(load_mesh(path, materials=True))
    }
    albedos = [found[side].albedo for side in (-1, 1)]
    if name == "a.ply":
        np.testing.assert_allclose(albedos, [linear(np.array(90 / 255)), bright], atol=1 / 64)
    else:
        assert albedos == list(ALBEDOS)
        assert [found[side].gloss.metal for side in (-1, 1)] == [False, True]
        assert found[1].gloss.transmission == 0.25
        assert found[1].gloss.roughness == 0.4


def test_without_materials_of_its_own_a_mesh_is_dressed_as_by_mixed(tmp_path):
    mesh = load_mesh(save(tmp_path, "a.off", SQUARE_OFF), materials=True)
    for seed in range(5):
        drawn, mixed = (dressed(mesh, which, seed) for which in (OWN, MIXED))
        assert [(b.albedo, b.gloss) for b in drawn] == [(b.albedo, b.gloss) for b in mixed]
    assert OWN.note(mesh) == "materials drawn: the file has none that are read"


def test_faces_without_one_are_drawn_and_counted(tmp_path):
    save(tmp_path, "plates.mtl", MTL)
    mesh = load_mesh(save(tmp_path, "a.obj", obj(first="printed")), materials=True)
    own, mixed = dressed(mesh), dressed(Mesh(mesh.vertices, mesh.faces), MIXED)
    drawn = {(b.albedo, b.gloss) for b in mixed}
    kinds = [(b.albedo, b.gloss) in drawn for b in own]
    assert sorted(kinds) == [False, True]
    said = OWN.note(mesh)
    assert said == ("materials drawn for 2 of 4 faces, 2 of them in pictures, which are not read")


# --- in the infrared picture


def check_two_radiances(path, renderer):
    """Both plates before camera and projector, against `gloss`'s formula for each."""
    mesh = UnitCube(yaw=False).place(load_mesh(path, materials=True), np.random.default_rng(0))
    bodies = dressed(mesh)
    eye = np.array([0.0, 0.0, 2.0])
    pose = look_at(eye, np.zeros(3))
    camera = Camera(Intrinsics.centred(48, 32, 60.0), pose)
    projector = Projector(pose, np.ones((8, 8), np.float32), 1.0, strength=2.0)
    (image,) = renderer.render(
        Scene(bodies, projector, ambient=0.5), [camera], seed=0, geometry=[True]
    )
    for body in bodies:
        middle = body.mesh.bounds.mean(axis=0)
        local = np.linalg.inv(pose) @ [*middle, 1]
        column, row = (np.rint(local[:2] / local[2] * 60 + [23.5, 15.5])).astype(int)
        way = (eye - middle) / np.linalg.norm(eye - middle)
        shine = times_pi(body.albedo, body.gloss, np.array([0.0, 0, 1]), way, way)
        expected = 0.5 * body.albedo + shine * 2 / local[2] ** 2
        expected *= 1 - body.gloss.transmission
        seen = image.radiance[row - 2 : row + 3, column - 2 : column + 3]
        assert seen.mean() == pytest.approx(expected, rel=0.05)
    assert len(bodies) == 2
    assert abs(np.subtract(*[b.albedo for b in bodies])) == pytest.approx(0.6)


def two_materials(folder, name):
    mtl = MTL.replace("d 0.75", "d 1")  # with one sample a clear plate is seen or not
    save(folder, "plates.mtl", mtl)
    opaque = [
        {"pbrMetallicRoughness": {"baseColorFactor": [a, 0, 0, 1], "metallicFactor": 0}}
        for a in ALBEDOS
    ]
    return save(folder, name, obj() if name == "a.obj" else glb(opaque))


@pytest.mark.parametrize("name", ["a.glb", "a.obj"])
def test_two_materials_of_a_file_are_two_radiances(name, tmp_path):
    renderer = MitsubaRenderer(samples=16)
    if renderer.variant.startswith("scalar_"):
        pytest.skip("no compiled variant works here")
    check_two_radiances(two_materials(tmp_path, name), renderer)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.glb", "a.obj"])
def test_two_materials_of_a_file_are_two_radiances_in_blender(name, tmp_path):
    check_two_radiances(two_materials(tmp_path, name), BlenderRenderer(samples=16))


# --- the command


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "meshes"
    for cls, name, content in (
        ("chair", "a.glb", glb()),
        ("table", "b.obj", obj()),
        ("table", "plates.mtl", MTL),
        ("lamp", "c.off", SQUARE_OFF),
    ):
        (root / cls / "train").mkdir(parents=True, exist_ok=True)
        save(root / cls / "train", name, content)
    return root


def test_the_plan_holds_the_libraries_too_and_only_where_they_are_read(folder, tmp_path):
    def objects(*words):
        cfg = config(tmp_path, folder, *words)
        return describe(cfg, mesh_items(cfg), {})["objects"]

    plain, own = objects(), objects("materials=own")
    mtl = folder / "table" / "train" / "plates.mtl"
    mtl.write_text(MTL.replace("0.05", "0.06"))
    assert objects() == plain
    changed = objects("materials=own")
    differ = [after for before, after in zip(own, changed, strict=True) if before != after]
    assert [line.split("/")[0] for line in differ] == ["table"]
    mtl.unlink()
    assert objects("materials=own") == plain


def test_what_is_drawn_is_said_of_each_object_and_counted(folder, tmp_path, caplog):
    caplog.set_level("INFO")
    words = ("materials=own", "workers=0", "views=1", "recipe.min_points=1", "splits=[train]")
    made = generate(config(tmp_path / "data", folder, *words))
    with open(tmp_path / "data" / "specklenet10" / "manifest.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["class"]: row["reason"] for row in rows} == {
        "chair": "",
        "table": "",
        "lamp": "materials drawn: the file has none that are read",
    }
    assert "files that do not say of all their faces what they are made of: 1 of 3;" in caplog.text
    assert str(made.made_of.sensor) == "speckle_stereo_small, the files' materials"


def test_a_mesh_that_is_sent_takes_its_library_along(folder, tmp_path):
    items = mesh_items(config(tmp_path, folder, "materials=own"))
    here = {item.id: item.load() for item in items}
    travelling = pickle.dumps(sent(items, keep_views=False))
    (folder / "table" / "train" / "plates.mtl").unlink()
    for item in pickle.loads(travelling):
        there = item.load()
        assert there.sha256 == here[item.id].sha256
        if here[item.id].finishes is None:
            assert there.finishes is None
        else:
            assert there.finishes.kinds == here[item.id].finishes.kinds


def test_meshes_from_memory_keep_what_was_read_of_their_files(tmp_path, caplog):
    words = ("domain=specklenet10", *QUICK, "views=1", "recipe.min_points=1", "materials=own")
    mesh = load_mesh(save(tmp_path, "a.glb", glb()), materials=True)
    told, plain = (
        qs3.generate(solid, *words).frames[0].images["left"]
        for solid in (mesh, Mesh(mesh.vertices, mesh.faces))
    )
    assert (told != plain).any()
    assert [record.getMessage() for record in caplog.records if "drawn" in record.getMessage()] == [
        "object: materials drawn: the file has none that are read"
    ]


def test_the_catalogue_has_no_materials_of_its_own():
    with pytest.raises(ConfigError, match="materials=own is for meshes of yours"):
        mesh_items(composed("domain=specklenet10", "materials=own"))
