"""What mesh files say their faces are made of."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import MeshError
from qs3.meshes.finishes import NONE, Finish, Finishes, linear
from qs3.meshes.formats.mtl import MAX_BYTES, libraries
from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh, merge
from qs3.meshes.placement import RealSize, UnitCube
from tests.meshes.coloured import BRIGHT, DARK, FACES, MODELS, MTL, PLATES, glb, obj, ply
from tests.meshes.written import save


def by_side(mesh):
    """The finishes of faces with x < 0, and of those with x > 0; None: nothing is said."""
    kinds = (*mesh.finishes.kinds, None)
    middles = mesh.vertices[mesh.faces].mean(axis=1)[:, 0]
    return [{kinds[i] for i in mesh.finishes.of_face[s]} for s in (middles < 0, middles > 0)]


def write_obj(folder, mtl=MTL, **names):
    if mtl is not None:
        save(folder, "plates.mtl", mtl)
    return save(folder, "a.obj", obj(**names))


# --- glTF


def test_gltf_says_colour_metal_roughness_and_alpha_of_each_face(tmp_path):
    mesh = load_mesh(save(tmp_path, "a.glb", glb()), materials=True)
    dark, bright = by_side(mesh)
    assert dark == {Finish(DARK, 0.9, 0.5, False, 0.0)}
    assert bright == {Finish(BRIGHT, 0.4, 0.5, True, 0.25)}
    assert mesh.finishes.missing == 0


def test_gltf_s_defaults_and_what_lies_in_pictures(tmp_path):
    picture = {"index": 0}
    rough = {"metallicRoughnessTexture": picture, "baseColorFactor": [1, 1, 1, 0.2]}
    for model, mode, expected in (
        ({}, "OPAQUE", Finish((1, 1, 1), 1.0, 0.5, True)),
        (rough, "OPAQUE", Finish((1, 1, 1), 0.5, 0.5, False)),
        (rough, "MASK", Finish((1, 1, 1), 0.5, 0.5, False, 1.0)),
        (rough, "BLEND", Finish((1, 1, 1), 0.5, 0.5, False, 0.8)),
    ):
        made = {"pbrMetallicRoughness": model, "alphaMode": mode}
        mesh = load_mesh(save(tmp_path, "a.glb", glb([made, {"name": "nothing"}])), materials=True)
        assert by_side(mesh) == [{expected}, {None}]
        assert (mesh.finishes.missing, mesh.finishes.pictured) == (2, 0)
    painted = {"pbrMetallicRoughness": {**MODELS[0], "baseColorTexture": picture}}
    mesh = load_mesh(save(tmp_path, "a.glb", glb([painted, {}])), materials=True)
    assert by_side(mesh) == [{None}, {None}]
    assert (mesh.finishes.missing, mesh.finishes.pictured) == (4, 2)


@pytest.mark.parametrize(
    ("material", "reason"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1]}}, "not four numbers"),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, "a"]}}, "Factor that is no num"),
        ({"pbrMetallicRoughness": {"roughnessFactor": True}}, "roughnessFactor that is no number"),
        ({"pbrMetallicRoughness": []}, "pbrMetallicRoughness is not an object"),
        ([], "a material that is not an object"),
    ],
)
def test_a_wrong_material_of_gltf_is_refused_where_it_is_asked_for(material, reason, tmp_path):
    path = save(tmp_path, "a.glb", glb([material, {}]))
    assert len(load_mesh(path).faces) == 4
    with pytest.raises(MeshError, match=reason) as caught:
        load_mesh(path, materials=True)
    assert str(path) in str(caught.value)


# --- OBJ


def test_obj_says_what_its_library_says(tmp_path):
    mesh = load_mesh(write_obj(tmp_path), materials=True)
    (dark,), (bright,) = by_side(mesh)
    # 2 / (6 + 2) = 0.25 is alpha squared, the square root of alpha is the roughness
    assert dark == replace(dark, colour=DARK, specular=0.25, metal=False, clear=0.0)
    assert dark.roughness == pytest.approx(0.5**0.5)
    assert bright == Finish(BRIGHT, 0.4, 0.5, True, 0.25)


def test_faces_before_the_first_usemtl_unknown_names_and_pictures_have_none(tmp_path):
    for first, second in (("nowhere", "printed"), ("printed", "dark")):
        mesh = load_mesh(write_obj(tmp_path, first=first, second=second), materials=True)
        assert by_side(mesh)[0] == {None}
        assert mesh.finishes.pictured == 2
    save(tmp_path, "a.obj", obj().replace("usemtl dark\n", ""))
    mesh = load_mesh(tmp_path / "a.obj", materials=True)
    assert by_side(mesh)[0] == {None}
    assert by_side(mesh)[1] != {None}


def test_a_library_that_is_not_there_says_nothing(tmp_path):
    path = write_obj(tmp_path, mtl=None)
    assert load_mesh(path, materials=True).finishes is None
    assert libraries(path) == []


@pytest.mark.parametrize(
    "name", ["../plates.mtl", "/etc/passwd", "sub/../../plates.mtl", "out.mtl"]
)
def test_no_library_outside_of_the_folder_is_opened(name, tmp_path, caplog):
    folder = tmp_path / "in"
    folder.mkdir()
    save(tmp_path, "plates.mtl", MTL)
    (folder / "out.mtl").symlink_to(tmp_path / "plates.mtl")
    path = save(folder, "a.obj", obj(library=name))
    assert load_mesh(path).finishes is None
    assert caplog.text == ""  # nobody asked
    assert load_mesh(path, materials=True).finishes is None
    assert f"{path}: mtllib {name!r} lies outside of the mesh's folder" in caplog.text
    assert libraries(path) == []


def test_a_library_beside_one_outside_of_the_folder(tmp_path, caplog):
    path = write_obj(tmp_path, library="/home/me/a.mtl plates.mtl")
    assert by_side(load_mesh(path, materials=True)) == by_side(
        load_mesh(write_obj(tmp_path), materials=True)
    )
    assert "/home/me/a.mtl" in caplog.text
    assert [p.name for p in libraries(path)] == ["plates.mtl"]


def test_names_with_a_number_sign(tmp_path):
    """As 3ds Max writes them; a comment has its own line, or stands behind numbers."""
    names = {"first": "Material #25", "second": "Material #26", "library": "chair#1.mtl"}
    text = (
        "# a comment\nnewmtl Material #25\n #newmtl dark\nKd .9 .9 .9 # bright\n"
        "newmtl Material #26\nKd 0.05 0.05 0.05#dark\n"
    )
    save(tmp_path, "chair#1.mtl", text)
    path = save(tmp_path, "a.obj", "#mtllib b.mtl\n# usemtl b\n" + obj(**names))
    mesh = load_mesh(path, materials=True)
    assert by_side(mesh) == [{Finish((0.9,) * 3)}, {Finish((0.05,) * 3)}]
    assert [p.name for p in libraries(path)] == ["chair#1.mtl"]
    names["library"] = "chair#1.mtl # of the chair"
    assert by_side(load_mesh(save(tmp_path, "a.obj", obj(**names)), materials=True)) == by_side(
        mesh
    )


def test_a_library_as_windows_names_it_and_with_byte_order_marks(tmp_path):
    plain = by_side(load_mesh(write_obj(tmp_path), materials=True))
    mark = b"\xef\xbb\xbf"
    library = (tmp_path / "plates.mtl").read_bytes()
    save(tmp_path, "plates.mtl", mark + library)
    text = obj().replace("mtllib plates.mtl", "  mtllib .\\plates.mtl")
    path = save(tmp_path, "a.obj", mark + text.encode())
    assert by_side(load_mesh(path, materials=True)) == plain
    assert [p.name for p in libraries(path)] == ["plates.mtl"]


def test_several_libraries_and_names_with_spaces(tmp_path):
    save(tmp_path, "b c.mtl", "newmtl bright one\nKd 0.5\n")
    path = write_obj(tmp_path, library="b c.mtl")
    assert by_side(load_mesh(path, materials=True)) == [{None}, {Finish((0.5, 0.5, 0.5))}]
    save(tmp_path, "b.mtl", "newmtl dark\nKd 0.25 0.25 0.25\n")
    save(tmp_path, "c.mtl", "newmtl bright one\nKd spectral a.rfl\n")
    path = write_obj(tmp_path, library="b.mtl c.mtl")
    (tmp_path / "b c.mtl").unlink()
    save(tmp_path, "a.obj", obj(library="b.mtl c.mtl"))
    assert by_side(load_mesh(path, materials=True)) == [{Finish((0.25, 0.25, 0.25))}, {None}]
    assert [p.name for p in libraries(path)] == ["b.mtl", "c.mtl"]


@pytest.mark.parametrize(
    ("mtl", "reason"),
    [
        ("newmtl dark\nKd one 0 0\n", r"plates\.mtl: material 'dark': Kd is no number: 'one'"),
        ("newmtl dark\nKd 0 0 0\nNs nan\n", "Ns is no number"),
        ("newmtl dark\nKd 0 0 0\nd\n", "d is no number"),
        ("#" * (MAX_BYTES + 1), "more than 16777216 bytes"),
    ],
)
def test_a_damaged_library_is_named(mtl, reason, tmp_path):
    with pytest.raises(MeshError, match=reason):
        load_mesh(write_obj(tmp_path, mtl=mtl), materials=True)


# --- PLY


@pytest.mark.parametrize("of", ["face", "vertex"])
@pytest.mark.parametrize(
    ("kind", "colours"),
    [("uchar", ((10, 100, 10), (255, 255, 255))), ("float", ((0, 100 / 255, 0), (1, 1, 1)))],
)
def test_ply_says_the_brightness_of_its_colours(of, kind, colours, tmp_path):
    mesh = load_mesh(save(tmp_path, "a.ply", ply(of, kind, colours)), materials=True)
    (dark,), (bright,) = by_side(mesh)
    assert dark.colour[0] == pytest.approx(float(linear(np.array(100 / 255))), abs=1 / 64)
    assert bright.colour == (1, 1, 1)


@pytest.mark.parametrize(
    ("kind", "dark", "bright"),
    [
        ("uchar", 0, 1),  # nearly black bytes, and not 0..1
        ("uchar", 1, 255),
        ("float", 0.5, 1),
        ("float", 128, 255),
        ("ushort", 128, 65535),
        ("int", 128, 255),
        ("int", 300, 65535),
    ],
)
def test_text_has_the_colours_of_the_type_that_its_header_names(kind, dark, bright, tmp_path):
    names = ("red", "green", "blue")
    lines = ["ply", "format ascii 1.0", "element vertex 8"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 4", "property list uchar int vertex_indices"]
    lines += [*(f"property {kind} {name}" for name in names), "end_header"]
    lines += [" ".join(map(str, point)) for point in PLATES]
    for (a, b, c), value in zip(FACES, (dark, dark, bright, bright), strict=True):
        lines.append(f"3 {a} {b} {c} {value} {value} {value}")
    mesh = load_mesh(save(tmp_path, "a.ply", "\n".join(lines)), materials=True)
    most = {"uchar": 255, "float": 1 if bright == 1 else 255, "int": bright}.get(kind, 65535)
    for faces, value in zip(by_side(mesh), (dark, bright), strict=True):
        (finish,) = faces
        assert finish.colour[0] == pytest.approx(float(linear(np.array(value / most))), abs=1 / 64)


def test_srgb_is_linear_below_its_knee_and_a_power_above():
    np.testing.assert_allclose(linear(np.array([0.04, 0.5, 1])), [0.04 / 12.92, 0.21404114, 1])


# --- through the pipeline


def test_geometry_is_the_same_whether_materials_are_read_or_not(tmp_path):
    write_obj(tmp_path)
    for path in (
        save(tmp_path, "a.glb", glb()),
        save(tmp_path, "a.ply", ply()),
        tmp_path / "a.obj",
    ):
        plain, told = load_mesh(path), load_mesh(path, materials=True)
        assert plain.sha256 == told.sha256
        assert plain.finishes is None
        assert told.finishes is not None


def test_turning_placing_and_merging_keep_them(tmp_path):
    mesh = load_mesh(save(tmp_path, "a.glb", glb()), materials=True)
    rng = np.random.default_rng(0)
    for moved in (
        mesh.transformed(np.eye(4)),
        UnitCube().place(mesh, rng),
        RealSize().place(mesh, rng),
    ):
        assert moved.finishes is mesh.finishes
    plain = Mesh(mesh.vertices + 5, mesh.faces)
    both = merge([plain, mesh])
    assert both.finishes.missing == 4
    kinds = (*both.finishes.kinds, None)
    assert [kinds[i] for i in both.finishes.of_face] == [None] * 4 + [
        mesh.finishes.kinds[i] for i in mesh.finishes.of_face
    ]
    assert merge([plain, plain]).finishes is None


def test_a_mesh_refuses_materials_of_another_number_of_faces(tmp_path):
    mesh = load_mesh(save(tmp_path, "a.glb", glb()))
    with pytest.raises(MeshError, match="materials of 3 of 4 faces"):
        replace(mesh, finishes=Finishes((), np.full(3, NONE, np.int32)))
