"""Every reader of files that others may have made, each with small whole files to begin with.

`test_readers.py` compares `covers` with the modules of qs3 that open files.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzzing.engine import Reader
from tests.fuzzing.mutate import GLB, MODEL_FOLDER, PACKED, PNG, TAR_GZ, ZIP, zipped

CLOUD = np.arange(12, dtype=np.float64).reshape(4, 3) / 8
TWO = ("bed", "chair")


def _bytes_of(*paths: Path) -> list[bytes]:
    return [path.read_bytes() for path in paths]


def _folder(folder: Path) -> bytes:
    """All files below a folder as one input, which `_laid_out` lays out again."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return zipped([(path.relative_to(folder).as_posix(), path.read_bytes()) for path in files])


def _laid_out(path: Path) -> Path:
    """The folder of an input; names of members that lead elsewhere are passed over."""
    root = path.parent / "folder"
    root.mkdir()
    try:
        with zipfile.ZipFile(path) as file:
            for info in file.infolist():
                name = info.filename
                parts = name.split("/")
                if name.isprintable() and len(name) < 100 and not {"", ".", ".."} & {*parts}:
                    at = root.joinpath(*parts[:-1])
                    at.mkdir(parents=True, exist_ok=True)
                    (at / parts[-1]).write_bytes(file.read(info))
    except Exception:  # a damaged input is a folder without the file, which is tried, too
        pass
    return root


def _half(path: Path) -> bool:
    """Of half of all inputs: whether checksums shall be made to match."""
    return bool(hashlib.sha256(path.read_bytes()).digest()[0] & 1)


# ---- meshes and clouds ----


def _mesh(name: str, *more: str) -> Reader:
    def seeds(folder: Path) -> list[bytes]:
        from tests.meshes.written import PRIMITIVES, dae, export, gltf, mixed_ply

        made = {
            "mixed.ply": lambda: mixed_ply(">"),
            "a.gltf": lambda: json.dumps(gltf()[0]).encode(),
            **{f"{key}.dae": (lambda key=key: dae(PRIMITIVES[key]).encode()) for key in PRIMITIVES},
        }
        return [made[one]() if one in made else export(one) for one in (name, *more)]

    def read(path: Path) -> None:
        from qs3.meshes.io import load_mesh

        load_mesh(path)

    suffix = name.rpartition(".")[2]
    shapes = {"3mf": PACKED, "glb": GLB}
    module = {"gltf": "gltf", "glb": "gltf", "dae": "collada", "3mf": "threemf"}.get(suffix, suffix)
    covers = ("meshes/io.py", f"meshes/formats/{module}.py", "meshes/formats/by_trimesh.py")
    return Reader(f"mesh .{suffix}", seeds, read, f"a.{suffix}", shapes.get(suffix), covers)


def _cloud(suffix: str, module: str, shape: Any = None) -> Reader:
    def seeds(folder: Path) -> list[bytes]:
        from tests.data.importers.own_clouds import write

        made = [write(folder / f"a{suffix}"), write(folder / f"b{suffix}", np.ones((1, 3)))]
        if suffix == ".xyz":
            made.append(write(folder / "a.txt"))
            made.append(folder / "commas.txt")
            made[-1].write_text("0,5;1,25;2,75\n1;2;3 # a\n")
        if suffix == ".pcd":
            made += _pcds(folder)
        if suffix in (".npy", ".npz"):
            _arrays(folder, suffix, made)
        if suffix == ".h5":
            made.append(_hdf5(folder / "many.h5"))
        return _bytes_of(*made)

    def read(path: Path) -> None:
        from qs3.clouds.files import parse_clouds
        from qs3.clouds.finite import checked, measured

        for cloud in parse_clouds(path).clouds[:50]:
            checked(measured(cloud, "a")[0], "a")
        if path.suffix == ".npz":
            from qs3.inference.inputs import is_archive

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


def _hdf5(path: Path) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=np.ones((3, 8, 3), "f4"), compression="gzip")
        file["label"] = np.array([0, 1, 1])
    return path


# ---- depth images and cameras ----


def _depth_pngs(folder: Path) -> list[bytes]:
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
    return _bytes_of(folder / "m.npy", folder / "mm.npy")


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
    ]


def _read_intrinsics(path: Path) -> None:
    from qs3.data.frames.given import read_intrinsics
    from qs3.errors import Qs3Error
    from qs3.sensors.fit.frames import read_camera

    try:
        read_intrinsics(str(path))
    except Qs3Error:
        read_camera(str(path), 640, 480)


def _lists(folder: Path) -> list[bytes]:
    row = {"depth": "a.png", "mask": "m.png", "object": 3, "intrinsics": [500, 500, 320, 240]}
    other = {"depth": "b.npy", "box": [1, 2, 30, 40], "up": "-y", "depth_scale": 0.001}
    listed = "- depth: a.png\n  box: [1, 2, 3, 4]\n  label: chair\n  up: &u [0, -1, 0]\n"
    table = 'depth,mask,object,box,intrinsics\na.png,m.png,1,,cam.json\nb.png,,,"1,2,3,4",\n'
    return [json.dumps([row, other]).encode(), listed.encode(), table.encode()]


def _read_list(path: Path) -> None:
    from qs3.inference.depth_list import Shown, find_shown

    if path.read_bytes()[:1] not in (b"[", b"-"):
        path = path.rename(path.with_suffix(".csv"))
    find_shown(str(path), "", Shown("", intrinsics="1,1,1,1"))


# ---- published datasets ----


def _nyu(folder: Path) -> list[bytes]:
    from tests.fixtures.frame_files import Shot, Thing, write_nyuv2

    shots = [Shot([Thing("chair", 0, 2.5)], camera=(20, 20, 6, 4), size=(9, 12), split="test")]
    write_nyuv2(folder, shots)
    return _bytes_of(folder / "nyu_depth_v2_labeled.mat")


def _read_nyu(path: Path) -> None:
    from qs3.data.frames.nyuv2 import LabelledFrames

    with LabelledFrames(path) as frames:
        for i in range(min(len(frames), 3)):
            frames.depth_m(i)
            frames.labels(i)
            frames.instances(i)


def _nyu_splits(folder: Path) -> list[bytes]:
    from scipy.io import savemat

    numbers = {"trainNdxs": np.array([[1.0], [2]]), "testNdxs": np.array([[3.0]])}
    savemat(folder / "a.mat", numbers)
    savemat(folder / "b.mat", numbers, do_compression=True)
    return _bytes_of(folder / "a.mat", folder / "b.mat")


def _read_nyu_splits(path: Path) -> None:
    from qs3.data.frames.nyuv2 import read_splits

    read_splits(path, 4)


def _sun(folder: Path) -> list[bytes]:
    from scipy.io import loadmat, savemat

    from tests.fixtures.frame_files import Shot, Thing, write_sunrgbd

    write_sunrgbd(folder, [Shot([Thing("chair", 0, 2.5)], camera=(20, 20, 6, 4), size=(9, 12))])
    table = loadmat(folder / "SUNRGBDMeta3DBB_v2.mat")["SUNRGBDMeta"]
    savemat(plain := folder / "plain.mat", {"SUNRGBDMeta": table})
    return _bytes_of(plain, folder / "SUNRGBDMeta3DBB_v2.mat", *folder.rglob("allsplit.mat"))


def _read_sun(path: Path) -> None:
    from qs3.data.frames import sunrgbd
    from qs3.errors import DataError

    try:
        sunrgbd.read_frames(path.parent)
    except DataError:
        sunrgbd.read_splits(path.parent, path.name)


def _sun_depth(folder: Path) -> list[bytes]:
    return _depth_pngs(folder)[:1]


def _read_sun_depth(path: Path) -> None:
    from pathlib import PurePosixPath

    from qs3.data.frames.images import Pinhole
    from qs3.data.frames.sunrgbd import Frame, open_image

    at = path.parent / "a" / "depth"
    at.mkdir(parents=True)
    path.rename(at / path.name)
    frame = Frame(1, "kv1", PurePosixPath("a"), Pinhole(20, 20, 4, 3), np.eye(3), ())
    open_image(path.parent, frame)


def _sens(folder: Path) -> list[bytes]:
    from tests.data.scannet.writing import Recording, intrinsics

    depth, k = np.arange(48, dtype=np.uint16).reshape(6, 8), intrinsics(20, 20, 4, 3)
    for compression in (0, 1):
        made = Recording([depth] * 2, [np.eye(4)] * 2, k, k, (8, 6), compression=compression)
        made.write(folder / f"{compression}.sens")
    return _bytes_of(folder / "0.sens", folder / "1.sens")


def _read_sens(path: Path) -> None:
    from qs3.data.scannet.sens import SensFile

    with SensFile(path) as file:
        for frame in range(min(len(file), 3)):
            file.has_pose(frame)
            file.depth_m(frame)


def _masks(folder: Path) -> list[bytes]:
    from tests.data.scannet.writing import write_zip

    images = {i: np.full((6, 8), i, dtype=np.uint8) for i in range(2)}
    write_zip(folder / "a.zip", "instance-filt", images)
    return _bytes_of(folder / "a.zip")


def _read_masks(path: Path) -> None:
    from qs3.data.scannet.masks import INSTANCES, MaskArchive

    with MaskArchive(path, INSTANCES) as masks:
        for frame in sorted(masks.frames)[:3]:
            masks.read(frame)


def _labels(folder: Path) -> list[bytes]:
    from tests.data.scannet.writing import write_aggregation, write_label_map

    write_label_map(folder / "map.tsv")
    write_aggregation(folder / "a.json", "scene0000_00", {0: "chair", 1: "wall", 2: "sofa"})
    return [*_bytes_of(folder / "map.tsv", folder / "a.json"), b"scene0000_00\nscene0001_01\n"]


def _read_labels(path: Path) -> None:
    from qs3.data.scannet.labels import LabelMap, read_label_map, read_objects, read_scene_list

    start = path.read_bytes()[:5]
    if start[:1] == b"{":
        read_objects(path, LabelMap({"chair": "chair", "sofa": "sofa"}, {2: "chair"}))
    elif start == b"scene":
        read_scene_list(path)
    else:
        read_label_map(path)


def _pointda(folder: Path) -> list[bytes]:
    return _bytes_of(_hdf5(folder / "a.h5"))


def _read_pointda(path: Path) -> None:
    from qs3.data.importers.pointda_h5 import read_h5

    read_h5(path, 2)


def _npz(write: Callable[..., Any]) -> bytes:
    write(buffer := io.BytesIO())
    return buffer.getvalue()


def _named(folder: Path) -> list[bytes]:
    words = {"cls": np.array(TWO), "split": np.array(["train", "test"]), "name": np.array(TWO)}
    return [_npz(lambda to: np.savez(to, points=np.ones((2, 3, 3), "f4"), **words))]


def _read_named(path: Path) -> None:
    from qs3.data.importers.arrays import NamedArrays

    NamedArrays(path.parent, file=path.name).items(TWO)


def _objects(folder: Path) -> list[bytes]:
    arrays = {
        "xyz_tenth_mm": np.ones((5, 3), np.int16), "start": np.array([0, 3, 5]),
        "centre_m": np.ones((2, 3), np.float32), "cls": np.array(TWO), "sub": np.array(TWO),
        "tier": np.array(["clean", "hard"]), "dev": np.array(["adapt", "judge"]),
        "img": np.array([1, 2]), "pixels": np.array([3, 2]), "rim": np.zeros(2, np.float32),
        "occ": np.zeros(2, np.float32), "inlier": np.ones(5, bool),
    }  # fmt: skip
    return [_npz(lambda to: np.savez(to, **arrays))]


def _read_objects(path: Path) -> None:
    from qs3.data.importers.object_archive import _contents, read_archive
    from qs3.inference.inputs import archive_units

    _contents(path)
    archive = read_archive(path)
    for i in range(min(len(archive), 3)):
        archive.cloud(i, inliers_only=True)
    for unit in archive_units(path, "", TWO)[:3]:
        list(unit())


# ---- our own formats, from others ----


def _stores(folder: Path) -> list[bytes]:
    from qs3.data.store import ManifestRow, write_pointset

    rows = [ManifestRow(f"{c}/train/0", c, "train", seed=1, more={"tier": "a"}) for c in TWO]
    write_pointset(
        folder / "store", name="made", classes=TWO, rows=rows, meta={"labels": {"a": [1, None]}},
        arrays={"points": np.ones((2, 3, 3)), "provenance": np.ones((2, 3, 1))},
        tables={"provenance": ["view"]},
    )  # fmt: skip
    return [_folder(folder / "store")]


def _read_store(path: Path) -> None:
    from qs3.data.made_of import MadeOf
    from qs3.data.meta import _CHECKSUM, sha256_of
    from qs3.data.store import open_pointset, open_table

    resum, folder = _half(path), _laid_out(path)
    meta = folder / "meta.yaml"
    if resum and meta.is_file():
        text = meta.read_bytes().decode(errors="replace").rpartition(_CHECKSUM)[0]
        for name in ("manifest.csv", "points.npy", "provenance.npy"):
            if (folder / name).is_file():
                found = hashlib.sha256((folder / name).read_bytes()).hexdigest()
                key = name.partition(".")[0]
                lines = [f"  {key}: {found}" if line.startswith(f"  {key}: ") else line
                         for line in text.split("\n")]  # fmt: skip
                text = "\n".join(lines)
        meta.write_text(text + _CHECKSUM + sha256_of(text) + "\n")
    data = open_pointset(folder)
    MadeOf.of(data.meta)
    open_table(folder)


def _parts(folder: Path) -> list[bytes]:
    from qs3.data.parts import PartFiles

    parts = PartFiles(folder / "store", "out")
    parts.begin({"a": 1, "b": {"c": [1, "x"]}})
    parts.write("p", {"rows": 1}, {"points": CLOUD})
    return [_folder(folder / "store")]


def _read_parts(path: Path) -> None:
    from qs3.data.parts import PartFiles

    parts = PartFiles(_laid_out(path), "out")
    if parts.have_recipe:
        parts.check({"a": 1, "b": {"c": [1, "x"]}})
    parts.read("p")


def _views(folder: Path) -> list[bytes]:
    from qs3.generation.view_files import save_view
    from qs3.geometry.cameras import Camera, Intrinsics
    from qs3.sensors.base import DepthFrame

    flat = np.ones((4, 5), np.float32)
    camera = Camera(Intrinsics(5, 4, 10.0, 2.0, 1.5), np.eye(4))
    small = np.zeros((4, 5), np.uint8)
    frame = DepthFrame(camera, 0, 0, 1, flat, flat, small, flat, small, {"left": flat})
    save_view(folder, "a", 0, frame, np.eye(4), np.eye(4))
    return _bytes_of(folder / "a" / "view_0.npz")


def _read_views(path: Path) -> None:
    from qs3.generation.view_files import load_views

    load_views(path.parent.parent, path.parent.name)


def _poses(folder: Path) -> list[bytes]:
    from tests.generation.released.test_poses import NAME, archive, npy, released, sofa

    return _bytes_of(archive(folder / "a.tar.gz", {NAME: npy(released(sofa(), views=2))}))


def _read_poses(path: Path) -> None:
    from qs3.generation.released.poses import read_poses

    read_poses.__wrapped__(path)


def _pickles(folder: Path) -> list[bytes]:
    from tests.generation.released.test_pickles import npy
    from tests.generation.released.test_poses import released, sofa

    return [npy(released(sofa(), views=2), protocol) for protocol in (3, 4)]


def _read_pickle(path: Path) -> None:
    from qs3.generation.released.poses import read_poses

    at = path.parent / "chair" / "test"
    at.mkdir(parents=True)
    path.rename(at / path.name)
    read_poses.__wrapped__(path.parent)


def _archives(folder: Path) -> list[bytes]:
    import tarfile

    from tests.generation.released.test_poses import archive

    members = {"a/b.txt": b"abc", "a/c.xyz": b"1 2 3\n" * 20, "__MACOSX/a/._b": b"x"}
    link = tarfile.TarInfo("a/link")
    link.type, link.linkname = tarfile.SYMTYPE, "b.txt"
    long = {"a/" + "n" * 120: b"abc"}
    made = archive(folder / "a.tar.gz", members), archive(folder / "b.tar.gz", {**long, "a": link})
    return _bytes_of(*made)


def _zips(folder: Path) -> list[bytes]:
    members = [("a/b.txt", b"abc"), ("a/c.xyz", b"1 2 3\n" * 20), ("__MACOSX/a/._b", b"x")]
    return [zipped(members), zipped(members, zipfile.ZIP_DEFLATED)]


def _unpack(path: Path) -> None:
    from qs3.data.download.archives import find_folder, unpack

    find_folder(unpack(path, path.parent / "into"), "c.xyz", at_least=1)


def _notes(folder: Path) -> list[bytes]:
    note = {"url": "u", "size": 3, "etag": None, "modified": "x"}
    return [json.dumps(note).encode(), json.dumps({"source": "a"}).encode()]


def _read_notes(path: Path) -> None:
    from qs3.data.download.catalogue import SOURCES
    from qs3.data.download.fetching import Resuming
    from qs3.data.download.provide import MARK, _is_in_place
    from qs3.sensors.bench.runner import read_cached

    read_cached(path)
    part = Resuming.__new__(Resuming)
    part.note = path
    part._read_note("u")
    (path.parent / "place").mkdir()
    path.rename(path.parent / "place" / MARK)
    _is_in_place(path.parent / "place", SOURCES[0])


# ---- what runs leave ----


def _runs(folder: Path) -> list[bytes]:
    from qs3.runs.metrics import write_metrics
    from qs3.runs.predictions import write_predictions
    from qs3.runs.pseudo_labels import path_of, write_pseudo_labels
    from tests.report.made_runs import metrics
    from tests.runs.test_predictions import predictions

    write_metrics(folder / "run", metrics())
    write_predictions(folder / "run" / "predictions.csv", predictions([2, 0]))
    rounds = path_of(folder / "run", 1)
    write_pseudo_labels(rounds, ["a", "b"], [0, 1], [0.5, 0.25], [True, False], TWO)
    (folder / "run" / "started.json").write_text('{"data": {"source": "a"}, "config": "b"}')
    (folder / "run" / "history.csv").write_text(
        "epoch,phase,lr,train_loss,source_val/acc\n0,0,0.1,1.5,0.5\n1,1,0.1,,0.75\n"
    )
    hydra = folder / "run" / ".hydra"
    hydra.mkdir()
    domain = {"name": "made", "symbol": "M", "title": "M", "path": "${paths.data_dir}/m"}
    cfg = {"paths": {"data_dir": "data"}, "data": {"source": domain, "target": domain}, "seed": 0}
    (hydra / "config.yaml").write_text(json.dumps(cfg))
    (hydra / "overrides.yaml").write_text("- seed=0\n- experiment=qs3_s2d\n")
    return [_folder(folder / "run")]


def _read_run(path: Path) -> None:
    from qs3.engine.loggers import CsvHistory
    from qs3.errors import Qs3Error
    from qs3.inference.export import _command
    from qs3.report.runs.data import read_run, settings_of
    from qs3.report.runs.domains import domain_of
    from qs3.report.tables.aggregate import load_runs
    from qs3.runs.folder import read_started
    from qs3.runs.pseudo_labels import path_of, read_pseudo_labels

    folder = _laid_out(path)
    _command(folder)
    for call in (
        lambda: read_started(folder),
        lambda: read_pseudo_labels(path_of(folder, 1)),
        lambda: CsvHistory(folder)._rows(),
        lambda: load_runs(folder.parent),
    ):
        with contextlib.suppress(Qs3Error):
            call()
    run = read_run(folder)
    settings_of(run)
    domain_of(run, "target")


def _checkpoints(folder: Path) -> list[bytes]:
    import torch

    from qs3.runs.checkpoints import save

    save({"weights": {"a": torch.ones(2, 3)}, "epoch": 3, "n": [1, None, "x"]}, folder / "a.ckpt")
    return _bytes_of(folder / "a.ckpt")


def _read_checkpoint(path: Path) -> None:
    from qs3.runs.checkpoints import check, load

    check(path, "again")
    load(path)


def _result() -> Any:
    import torch

    from qs3.inference.model_file import Result

    model = {"_target_": "qs3.models.pointnet.pointnet", "num_classes": 2, "variant": "basic"}
    usual = {"points": [8.0, float("inf")]}
    from qs3.evaluation.ood import ALL

    usual = {next(iter(ALL)): [0.0, float("inf")]}
    return Result(model, TWO, 8, 16, "made", "z", "unit_ball", usual, {"w": torch.ones(2, 3)})


def _results(folder: Path) -> list[bytes]:
    from qs3.inference.model_file import write_result

    write_result(folder / "result.pt", _result())
    return _bytes_of(folder / "result.pt")


def _read_result(path: Path) -> None:
    from qs3.errors import Qs3Error
    from qs3.inference.model_file import build_net, read_result

    result = read_result(path)
    with contextlib.suppress(Qs3Error):  # these weights are not those of the net
        build_net(result)


def _models(folder: Path) -> list[bytes]:
    from qs3.inference.model_file import values_of
    from qs3.inference.model_folder import write_folder

    write_folder(folder / "model", values_of(_result()), "card")
    return [_folder(folder / "model")]


def _read_model(path: Path) -> None:
    resum, folder = _half(path), _laid_out(path)
    config, weights = folder / "config.json", folder / "model.safetensors"
    if resum and config.is_file() and weights.is_file():
        try:
            about = json.loads(config.read_bytes())
            about["weights_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
            config.write_text(json.dumps(about))
        except (ValueError, TypeError, RecursionError):
            pass
    _read_result(folder)


def _tables(folder: Path) -> list[bytes]:
    table = "title: mine\nmetrics: [accuracy]\ncolumns: [a]\nrows:\n- name: b\n  a:\n    paper: 1\n"
    return [table.encode(), b"&a {title: x, metrics: [accuracy], columns: [*a], rows: []}"]


def _read_table(path: Path) -> None:
    from qs3.report.tables.table import build_table

    build_table(str(path), path.parent)


def _journals(folder: Path) -> list[bytes]:
    job = {"job": 0, "folder": "a", "overrides": ["seed=0"], "error": ""}
    return ["\n".join(json.dumps({**job, "job": i}) for i in range(2)).encode()]


def _read_journal(path: Path) -> None:
    from qs3.sweeps.summary import SummaryOfSeeds, differences, failures, last_words

    summary = SummaryOfSeeds.__new__(SummaryOfSeeds)
    summary.journal = path
    jobs = last_words(summary._read())
    failures(jobs)
    differences(jobs)


def _caches(folder: Path) -> list[bytes]:
    from qs3.datamodules.fps_cache import _kept

    _kept(folder / "a.npy", np.arange(8, dtype=np.uint16).reshape(2, 4), "made")
    return _bytes_of(folder / "a.npy")


def _read_cache(path: Path) -> None:
    from qs3.datamodules.fps_cache import _read

    _read(path, (2, 4), "made")


READERS: tuple[Reader, ...] = (
    _mesh("a.off"),
    _mesh("a.obj"),
    _mesh("a.ply", "ascii.ply", "mixed.ply"),
    _mesh("a.stl", "ascii.stl"),
    _mesh("a.gltf"),
    _mesh("a.glb"),
    _mesh("triangles.dae", "polylist.dae", "polygons.dae"),
    _mesh("a.3mf"),
    _cloud(".xyz", "text"),
    _cloud(".npy", "arrays"),
    _cloud(".npz", "arrays", PACKED),
    _cloud(".ply", "files"),
    _cloud(".pcd", "pcd"),
    _cloud(".h5", "hdf5"),
    Reader("depth or mask .png", _depth_pngs, _read_depth, "a.png", PNG,
           ("data/frames/given.py", "utils/pictures.py")),
    Reader("depth or mask .npy", _depth_npys, _read_depth, "a.npy", None, ("clouds/arrays.py",)),
    Reader("frame to fit .png", _depth_pngs, _read_frame, "a.png", PNG, ("sensors/fit/frames.py",)),
    Reader("frame to fit .npy", _depth_npys, _read_frame, "a.npy"),
    Reader("intrinsics", _intrinsics, _read_intrinsics, "a.json"),
    Reader("list of pictures", _lists, _read_list, "a.yaml", None,
           ("inference/depth_list.py", "utils/yamls.py")),
    Reader("NYUv2 .mat 7.3", _nyu, _read_nyu, "a.mat", None,
           ("data/frames/nyuv2.py", "data/frames/matlab.py")),
    Reader("NYUv2 splits .mat", _nyu_splits, _read_nyu_splits, "a.mat"),
    Reader("SUN RGB-D .mat", _sun, _read_sun, "SUNRGBDMeta3DBB_v2.mat", None,
           ("data/frames/sunrgbd.py",)),
    Reader("SUN RGB-D .png", _sun_depth, _read_sun_depth, "a.png", PNG),
    Reader("ScanNet .sens", _sens, _read_sens, "a.sens", None, ("data/scannet/sens.py",)),
    Reader("ScanNet masks .zip", _masks, _read_masks, "a.zip", PACKED, ("data/scannet/masks.py",)),
    Reader("ScanNet labels", _labels, _read_labels, "a.txt", None, ("data/scannet/labels.py",)),
    Reader("PointDA .h5", _pointda, _read_pointda, "a.h5", None, ("data/importers/pointda_h5.py",)),
    Reader("named arrays .npz", _named, _read_named, "a.npz", PACKED),
    Reader("cut objects .npz", _objects, _read_objects, "a.npz", PACKED,
           ("data/importers/object_archive.py",)),
    Reader("store", _stores, _read_store, "a.zip", ZIP,
           ("data/store.py", "data/meta.py", "data/manifest.py")),
    Reader("parts of a store", _parts, _read_parts, "a.zip", ZIP, ("data/parts.py",)),
    Reader("kept views .npz", _views, _read_views, "view_0.npz", PACKED,
           ("generation/view_files.py",)),
    Reader("poses .tar.gz", _poses, _read_poses, "a.tar.gz", TAR_GZ,
           ("generation/released/poses.py", "utils/tars.py")),
    Reader("poses .npy", _pickles, _read_pickle, "a.npy", None,
           ("generation/released/pickles.py",)),
    Reader("archive .tar.gz", _archives, _unpack, "a", TAR_GZ, ("data/download/archives.py",)),
    Reader("archive .zip", _zips, _unpack, "a", ZIP),
    Reader("notes .json", _notes, _read_notes, "a.json", None,
           ("data/download/fetching.py", "data/download/provide.py", "sensors/bench/runner.py")),
    Reader("run", _runs, _read_run, "a.zip", ZIP,
           ("runs/metrics.py", "runs/predictions.py", "runs/pseudo_labels.py", "runs/folder.py",
            "report/runs/data.py", "engine/loggers.py", "inference/export.py")),
    Reader("checkpoint", _checkpoints, _read_checkpoint, "a.ckpt", ZIP, ("runs/checkpoints.py",)),
    Reader("result .pt", _results, _read_result, "result.pt", ZIP, ("inference/model_file.py",)),
    Reader("model folder", _models, _read_model, "a.zip", MODEL_FOLDER,
           ("inference/model_folder.py", "inference/tensor_file.py")),
    Reader("table .yaml", _tables, _read_table, "a.yaml", None, ("report/tables/table.py",)),
    Reader("journal of a sweep", _journals, _read_journal, "a.txt", None, ("sweeps/summary.py",)),
    Reader("cache of samples", _caches, _read_cache, "a.npy", None, ("datamodules/fps_cache.py",)),
)  # fmt: skip
