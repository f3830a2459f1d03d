"""Readers of published datasets, of stores of clouds, of poses and of archives."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzzing.engine import Reader
from tests.fuzzing.inputs import CLOUD, TWO, bytes_of, folder_of, half_of_all, laid_out
from tests.fuzzing.mutate import PACKED, PNG, TAR_GZ, ZIP, zipped
from tests.fuzzing.of_geometry import depth_pngs, many_in_hdf5


def _nyu(folder: Path) -> list[bytes]:
    from tests.fixtures.frame_files import Shot, Thing, write_nyuv2

    shots = [Shot([Thing("chair", 0, 2.5)], camera=(20, 20, 6, 4), size=(9, 12), split="test")]
    write_nyuv2(folder, shots)
    return bytes_of(folder / "nyu_depth_v2_labeled.mat")


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
    return bytes_of(folder / "a.mat", folder / "b.mat")


def _read_nyu_splits(path: Path) -> None:
    from qs3.data.frames.nyuv2 import read_splits

    read_splits(path, 4)


def _sun(folder: Path) -> list[bytes]:
    from scipy.io import loadmat, savemat

    from tests.fixtures.frame_files import Shot, Thing, write_sunrgbd

    write_sunrgbd(folder, [Shot([Thing("chair", 0, 2.5)], camera=(20, 20, 6, 4), size=(9, 12))])
    table = loadmat(folder / "SUNRGBDMeta3DBB_v2.mat")["SUNRGBDMeta"]
    savemat(plain := folder / "plain.mat", {"SUNRGBDMeta": table})
    return bytes_of(plain, folder / "SUNRGBDMeta3DBB_v2.mat", *folder.rglob("allsplit.mat"))


def _read_sun(path: Path) -> None:
    from qs3.data.frames import sunrgbd
    from qs3.errors import DataError

    try:
        sunrgbd.read_frames(path.parent)
    except DataError:
        sunrgbd.read_splits(path.parent, path.name)


def _sun_depth(folder: Path) -> list[bytes]:
    return depth_pngs(folder)[:1]


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
    return bytes_of(folder / "0.sens", folder / "1.sens")


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
    return bytes_of(folder / "a.zip")


def _read_masks(path: Path) -> None:
    from qs3.data.scannet.masks import INSTANCES, MaskArchive

    with MaskArchive(path, INSTANCES) as masks:
        for frame in sorted(masks.frames)[:3]:
            masks.read(frame)


def _labels(folder: Path) -> list[bytes]:
    from tests.data.scannet.writing import write_aggregation, write_label_map

    write_label_map(folder / "map.tsv")
    write_aggregation(folder / "a.json", "scene0000_00", {0: "chair", 1: "wall", 2: "sofa"})
    return [*bytes_of(folder / "map.tsv", folder / "a.json"), b"scene0000_00\nscene0001_01\n"]


def _read_labels(path: Path) -> None:
    from qs3.data.scannet.labels import LabelMap, read_label_map, read_objects, read_scene_list

    with open(path, "rb") as file:
        start = file.read(5)
    if start[:1] == b"{":
        read_objects(path, LabelMap({"chair": "chair", "sofa": "sofa"}, {2: "chair"}))
    elif start == b"scene":
        read_scene_list(path)
    else:
        read_label_map(path)


def _pointda(folder: Path) -> list[bytes]:
    return bytes_of(many_in_hdf5(folder / "a.h5"))


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
    from qs3.inference.floor import floor_under
    from qs3.inference.inputs import archive_part, archive_units

    _contents(path)
    archive = read_archive(path)
    for i in range(min(len(archive), 3)):
        archive.cloud(i, inliers_only=True)
    chosen = archive_part(archive, "all")[0][:3]
    for unit in archive_units(archive, chosen, TWO):
        list(unit())
    floor_under([archive.cloud(i, inliers_only=True) for i in chosen] * 10)


def _stores(folder: Path) -> list[bytes]:
    from qs3.data.store import ManifestRow, write_pointset

    rows = [ManifestRow(f"{c}/train/0", c, "train", seed=1, more={"tier": "a"}) for c in TWO]
    for name, shard_mb in (("store", 1), ("shards", 40e-6)):  # of one cloud each
        write_pointset(
            folder / name, name="made", classes=TWO, rows=rows, meta={"labels": {"a": [1, None]}},
            arrays={"points": np.ones((2, 3, 3)), "provenance": np.ones((2, 3, 1))},
            tables={"provenance": ["view"]}, shard_mb=shard_mb,
        )  # fmt: skip
    return [folder_of(folder / "store"), folder_of(folder / "shards")]


def _read_store(path: Path) -> None:
    from qs3.data.made_of import MadeOf
    from qs3.data.meta import _CHECKSUM, sha256_of
    from qs3.data.store import open_pointset, open_table

    resum, folder = half_of_all(path), laid_out(path)
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
    return [folder_of(folder / "store")]


def _read_parts(path: Path) -> None:
    from qs3.data.parts import PartFiles

    parts = PartFiles(laid_out(path), "out")
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
    return bytes_of(folder / "a" / "view_0.npz")


def _read_views(path: Path) -> None:
    from qs3.generation.view_files import load_views

    load_views(path.parent.parent, path.parent.name)


def _poses(folder: Path) -> list[bytes]:
    from tests.generation.released.test_poses import NAME, archive, npy, released, sofa

    return bytes_of(archive(folder / "a.tar.gz", {NAME: npy(released(sofa(), views=2))}))


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
    return bytes_of(*made)


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


READERS: tuple[Reader, ...] = (
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
           ("data/store.py", "data/meta.py", "data/manifest.py", "data/array_files.py")),
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
)  # fmt: skip
