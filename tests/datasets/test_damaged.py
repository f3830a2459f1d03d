"""Each format damaged in five ways gives a DataError that names the file; nothing is unpickled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qs3.classes import CLASSES
from qs3.datasets.clouds import parse_clouds
from qs3.datasets.depth_images import read_depth, read_intrinsics, read_mask
from qs3.datasets.frames import load_mat
from qs3.datasets.nyuv2 import LabelledFrames, read_splits
from qs3.datasets.object_archive import read_archive
from qs3.datasets.published import named_arrays, read_h5, sample_file
from qs3.datasets.scannet_files import (
    INSTANCES,
    MaskArchive,
    SensFile,
    read_label_map,
    read_objects,
    read_scene_list,
)
from qs3.datasets.sunrgbd import read_frames
from qs3.errors import DataError
from tests.datasets import own_clouds
from tests.datasets.test_scannet_files import recording
from tests.datasets.writing import write_zip
from tests.fixtures import frame_files, published
from tests.fixtures.frame_files import Shot, Thing
from tests.fixtures.harm import Harm
from tests.fixtures.modelnet import boxes, off_text

ONE = {"train": 1}
SHOTS = [Shot([Thing("chair", 0, 2.4, 35)], split=split) for split in ("train", "test")]
LABELS = "id\traw_category\tcategory\n" + "".join(
    f"{i}\t{name}\t{name}\n"
    for i, name in enumerate(
        ("bathtub", "bed", "shelf", "cabinet", "chair", "lamp", "monitor", "plant", "couch",
         "table"), start=1,
    )
)  # fmt: skip


def cloud(suffix: str) -> tuple[str, Callable, Callable]:
    return f"a{suffix}", own_clouds.write, parse_clouds


def text(content: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(content)


def image(dtype: type) -> Callable[[Path], Any]:
    import cv2

    picture = np.full((40, 60), 1500 if dtype is np.uint16 else 1, dtype)
    return lambda path: cv2.imwrite(str(path), picture)


def frames_of(path: Path) -> None:
    frame_files.write_nyuv2(path.parent, SHOTS)


def mat(path: Path) -> None:
    frames_of(path)
    (path.parent / "nyu_depth_v2_labeled.mat").rename(path)


def boxes_of(path: Path) -> None:
    frame_files.write_sunrgbd(path.parent, SHOTS)


def first_depth(path: Path) -> Any:
    with SensFile(path) as sens:
        return sens.depth_m(0)


def read_label_map_of(path: Path) -> Any:
    (path.parent / "labels.tsv").write_text(LABELS)
    return read_label_map(path.parent / "labels.tsv")


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "begin": lambda data: data[: len(data) // 9],
    "noise": lambda data: np.random.default_rng(0).bytes(len(data)),
    "zeros": lambda data: bytes(len(data)),
    "another format": lambda data: b"%PDF-1.7\n" + data[::-1],
}


FORMATS: dict[str, tuple[str, Callable, Callable]] = {
    **{suffix: cloud(suffix) for suffix in own_clouds.FORMATS},
    "off": ("a.off", text(off_text(*boxes("chair", "a"))), lambda p: sample_file(p, 8, 0)),
    "pointda": (
        "train_0.h5",
        lambda p: published.write_pointda_h5(p.parent, ONE, points=16, files=1),
        lambda p: list(read_h5(p, "train", CLASSES, 4)),
    ),
    "named arrays": ("a.npz", lambda p: published.write_named_arrays(p, ONE), named_arrays),
    "archive": ("a.npz", lambda p: frame_files.write_archive(p, ONE), read_archive),
    "depth": ("a.png", image(np.uint16), read_depth),
    "mask": ("a.png", image(np.uint8), read_mask),
    "intrinsics": (
        "a.json", text('{"fx": 5, "fy": 5, "cx": 3, "cy": 2}'), lambda p: read_intrinsics(str(p))
    ),
    "nyuv2": ("a.mat", mat, lambda p: LabelledFrames(p).depth_m(0)),
    "nyuv2 splits": ("splits.mat", frames_of, lambda p: read_splits(p, 2)),
    "sunrgbd": ("SUNRGBDMeta3DBB_v2.mat", boxes_of, lambda p: read_frames(p.parent)),
    "matlab": ("splits.mat", frames_of, load_mat),
    "sens": ("a.sens", lambda p: recording().write(p), first_depth),
    "masks": (
        "a.zip",
        lambda p: write_zip(p, INSTANCES, {0: np.ones((4, 6), np.uint8)}),
        lambda p: MaskArchive(p, INSTANCES).read(0),
    ),
    "label map": ("a.tsv", text(LABELS), read_label_map),
    "aggregation": (
        "a.json",
        text('{"segGroups": [{"objectId": 0, "label": "chair"}]}'),
        lambda p: read_objects(p, read_label_map_of(p)),
    ),
    "scene list": ("a.txt", text("scene0000_00\nscene0001_00\n"), read_scene_list),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_named(name: str, damage: str, tmp_path: Path) -> None:
    file, write, read = FORMATS[name]
    path = tmp_path / file
    write(path)
    read(path)  # it was whole
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.raises(DataError, match=file.replace(".", r"\.")):
        read(path)


@pytest.mark.parametrize("read", [parse_clouds, named_arrays, read_archive])
def test_nothing_is_unpickled(read: Callable, tmp_path: Path) -> None:
    harm = np.array([Harm(tmp_path / "harm")], dtype=object)
    keys = ("points", "cls", "split", "name", "xyz_tenth_mm", "centre_m", "start", "tier", "img")
    np.savez(tmp_path / "a.npz", **dict.fromkeys(keys, harm))
    np.save(tmp_path / "a.npy", harm, allow_pickle=True)
    for path in (tmp_path / "a.npz", tmp_path / "a.npy"):
        with pytest.raises(DataError, match=path.name):
            read(path)
    assert not (tmp_path / "harm").exists()
