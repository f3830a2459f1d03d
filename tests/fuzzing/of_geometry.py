"""Readers of meshes, clouds, depth images and cameras."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzzing.engine import Reader
from tests.fuzzing.inputs import CLOUD, bytes_of
from tests.fuzzing.mutate import GLB, PACKED, PNG


def _mesh(name: str, *more: str) -> Reader:
    def seeds(folder: Path) -> list[bytes]:
        from tests.meshes import coloured
        from tests.meshes.written import PRIMITIVES, dae, export, gltf, mixed_ply

        made = {
            "coloured.glb": coloured.glb,
            "coloured.obj": lambda: coloured.obj().encode(),
            "faces.ply": coloured.ply,
            "vertices.ply": lambda: coloured.ply("vertex", "float"),
            "mixed.ply": lambda: mixed_ply(">"),
            "a.gltf": lambda: json.dumps(gltf()[0]).encode(),
            **{f"{key}.dae": (lambda key=key: dae(PRIMITIVES[key]).encode()) for key in PRIMITIVES},
        }
        return [made[one]() if one in made else export(one) for one in (name, *more)]

    def read(path: Path) -> None:
        from qs3.meshes.formats.gltf import buffer_files
        from qs3.meshes.io import load_mesh

        buffer_files(path)
        load_mesh(path, materials=True)

    suffix = name.rpartition(".")[2]
    shapes = {"3mf": PACKED, "glb": GLB}
    module = {"gltf": "gltf", "glb": "gltf", "dae": "collada", "3mf": "threemf"}.get(suffix, suffix)
    covers = ("meshes/io.py", f"meshes/formats/{module}.py", "meshes/formats/by_trimesh.py")
    return Reader(f"mesh .{suffix}", seeds, read, f"a.{suffix}", shapes.get(suffix), covers)


def _mtls(folder: Path) -> list[bytes]:
    from tests.meshes.coloured import MTL

    return [MTL.encode(), b"newmtl dark\nKd spectral a 1\nKs xyz 1\nNs 1e9\nTr .5\nPr 0.1\n"]


def _read_mtl(path: Path) -> None:
    from qs3.meshes.io import load_mesh
    from tests.meshes.coloured import obj

    mesh = path.with_suffix(".obj")
    mesh.write_text(obj(library=path.name))
    load_mesh(mesh, materials=True)


def _cloud(suffix: str, module: str, shape: Any = None) -> Reader:
    def seeds(folder: Path) -> list[bytes]:
        from tests.data.importers.own_clouds import write

        made = [write(folder / f"a{suffix}"), write(folder / f"b{suffix}", np.ones((1, 3)))]
        if suffix == ".xyz":
            made.append(write(folder / "a.txt"))
            made.append(folder / "commas.txt")
            made[-1].write_text("0,5;1,25;2,75\n1;2;3 # a\n")
            made.append(folder / "names.txt")
            made[-1].write_text("x,y,z\n1,2,3\n4,5,6\n")
        if suffix == ".pcd":
            made += _pcds(folder)
        if suffix in (".npy", ".npz"):
            _arrays(folder, suffix, made)
        if suffix == ".h5":
            made.append(many_in_hdf5(folder / "many.h5"))
        return bytes_of(*made)

    def read(path: Path) -> None:
        from qs3.clouds.files import parse_clouds
        from qs3.clouds.finite import checked, measured

        for cloud in parse_clouds(path).clouds[:50]:
            checked(measured(cloud, "a")[0], "a")
        if path.suffix == ".npz":
            from qs3.data.place import is_archive

            is_archive(path)
        if path.suffix == ".npy":
            from qs3.clouds.files import npy_clouds

            npy_clouds(path)

    covers = (f"clouds/{module}.py", "clouds/files.py", "clouds/arrays.py")
    more = ("inference/inputs.py",) if suffix == ".npz" else ()
    more += ("report/view/command.py",) if suffix == ".ply" else ()
    return Reader(f"cloud {suffix}", seeds, read, f"a{suffix}", shape, covers + more)


def _arrays(folder: Path, suffix: str, made: list[Path]) -> None:
    made.append(folder / f"many{suffix}")
    many = np.stack([CLOUD, CLOUD + 1])
    if suffix == ".npy":
        np.save(made[-1], many)
    else:
        np.savez_compressed(made[-1], points=many, label=np.array(["bed", "chair"]))


def _pcds(folder: Path) -> list[Path]:
    head = "VERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    head += "WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA "
    body = np.arange(6, dtype="<f4").tobytes() + b"\1\0\2\0"
    plain, packed = folder / "b.pcd", folder / "c.pcd"
    plain.write_bytes(f"{head}binary\n".encode() + body)
    literal = bytes([len(body) - 1]) + body  # LZF: all of it as it is
    sizes = np.array([len(literal), len(body)], dtype="<u4").tobytes()
    packed.write_bytes(f"{head}binary_compressed\n".encode() + sizes + literal)
    return [plain, packed]


def many_in_hdf5(path: Path) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=np.ones((3, 8, 3), "f4"), compression="gzip")
        file["label"] = np.array([0, 1, 1])
    return path


def depth_pngs(folder: Path) -> list[bytes]:
    import cv2
    from PIL import Image

    rng = np.random.default_rng(0)
    grey = rng.integers(0, 3000, (6, 8)).astype(np.uint16)
    palette = Image.fromarray((grey % 4).astype(np.uint8)).convert("P")
    palette.save(buffer := io.BytesIO(), "PNG")
    small = cv2.imencode(".png", (grey % 5).astype(np.uint8))[1].tobytes()
    return [cv2.imencode(".png", grey)[1].tobytes(), small, buffer.getvalue()]


def _depth_npys(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    np.save(folder / "m.npy", rng.uniform(0.5, 3, (6, 8)))
    np.save(folder / "mm.npy", rng.integers(0, 3000, (6, 8)).astype(np.uint16))
    return bytes_of(folder / "m.npy", folder / "mm.npy")


def _read_depth(path: Path) -> None:
    from qs3.data.frames.given import read_depth, read_mask
    from qs3.errors import DataError

    try:
        read_mask(path)
    except DataError:
        read_depth(path)


def _read_frame(path: Path) -> None:
    from qs3.sensors.fit.frames import read_frame

    read_frame(path)


def _intrinsics(folder: Path) -> list[bytes]:
    matrix = [500.0, 0, 320, 0, 500, 240, 0, 0, 1]
    opencv = "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
    return [
        b"500,500,320,240",
        b"500 0 320 0\n0 500 240 0\n0 0 1 0\n0 0 0 1\n",
        json.dumps({"width": 640, "height": 480, "intrinsic_matrix": matrix}).encode(),
        json.dumps({"fx": 1, "fy": 1, "ppx": 0, "ppy": 0, "coeffs": [0, 0, 0]}).encode(),
        f"{opencv}  data: {matrix}\nD: [0.1, 0]\n".encode(),
        f"K: {matrix}\nwidth: 640\nheight: 480\n---\nK: {matrix}\n---\n".encode(),
    ]


def _matrices(folder: Path) -> list[bytes]:
    np.save(folder / "K.npy", np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    np.save(folder / "four.npy", np.array([500, 500, 320, 240]))
    return bytes_of(folder / "K.npy", folder / "four.npy")


def _read_matrix(path: Path) -> None:
    from qs3.data.frames.given import read_intrinsics

    read_intrinsics(str(path))


def _read_intrinsics(path: Path) -> None:
    from qs3.data.frames.given import read_intrinsics
    from qs3.errors import Qs3Error
    from qs3.sensors.fit.frames import read_camera

    try:
        read_intrinsics(str(path))
    except Qs3Error:
        with contextlib.suppress(Qs3Error):
            read_camera(str(path), 640, 480)
        read_camera(str(path.rename(path.with_suffix(".yaml"))), 640, 480)


def _lists(folder: Path) -> list[bytes]:
    row = {"depth": "a.png", "mask": "m.png", "object": 3, "intrinsics": [500, 500, 320, 240]}
    other = {"depth": "b.npy", "box": [1, 2, 30, 40], "up": "-y", "depth_scale": 0.001}
    listed = "- depth: a.png\n  box: [1, 2, 3, 4]\n  label: chair\n  up: &u [0, -1, 0]\n"
    table = 'depth,mask,object,box,intrinsics\na.png,m.png,1,,cam.json\nb.png,,,"1,2,3,4",\n'
    return [json.dumps([row, other]).encode(), listed.encode(), table.encode()]


def _materials(folder: Path) -> list[bytes]:
    ours = (Path(__file__).parents[2] / "conf" / "materials" / "mixed.yaml").read_bytes()
    kind = "{weight: 1, albedo: &a [0.1, 0.2], roughness: *a, metal: true, transmission: null}"
    return [ours, f"materials:\n  max_materials: 1\n  kinds:\n    a: {kind}\n".encode()]


def _read_materials(path: Path) -> None:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from qs3.generation.materials_file import with_materials

    OverridesParser.create().parse_overrides(with_materials([f"materials={path}"]))


def _read_list(path: Path) -> None:
    from qs3.inference.depth_list import Shown, find_shown

    with open(path, "rb") as file:
        start = file.read(1)
    if start not in (b"[", b"-"):
        path = path.rename(path.with_suffix(".csv"))
    find_shown(str(path), "", Shown("", intrinsics="1,1,1,1"))


READERS: tuple[Reader, ...] = (
    _mesh("a.off"),
    _mesh("a.obj", "coloured.obj"),
    _mesh("a.ply", "ascii.ply", "mixed.ply", "faces.ply", "vertices.ply"),
    _mesh("a.stl", "ascii.stl"),
    _mesh("a.gltf"),
    _mesh("a.glb", "coloured.glb"),
    _mesh("triangles.dae", "polylist.dae", "polygons.dae"),
    _mesh("a.3mf"),
    Reader("materials .mtl", _mtls, _read_mtl, "a.mtl", None, ("meshes/formats/mtl.py",)),
    _cloud(".xyz", "text"),
    _cloud(".npy", "arrays"),
    _cloud(".npz", "arrays", PACKED),
    _cloud(".ply", "files"),
    _cloud(".pcd", "pcd"),
    _cloud(".h5", "hdf5"),
    Reader("depth or mask .png", depth_pngs, _read_depth, "a.png", PNG,
           ("data/frames/given.py", "utils/pictures.py")),
    Reader("depth or mask .npy", _depth_npys, _read_depth, "a.npy", None, ("clouds/arrays.py",)),
    Reader("frame to fit .png", depth_pngs, _read_frame, "a.png", PNG, ("sensors/fit/frames.py",)),
    Reader("frame to fit .npy", _depth_npys, _read_frame, "a.npy"),
    Reader("intrinsics", _intrinsics, _read_intrinsics, "a.json"),
    Reader("intrinsics .npy", _matrices, _read_matrix, "a.npy"),
    Reader("list of pictures", _lists, _read_list, "a.yaml", None,
           ("inference/depth_list.py", "utils/yamls.py")),
    Reader("materials .yaml", _materials, _read_materials, "a.yaml", None,
           ("generation/materials_file.py",)),
)  # fmt: skip
