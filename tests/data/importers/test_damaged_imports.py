"""Every published format against the same damages, through the domain as a user has it.

A damage must be a clear error that names the file, or, with on_error=skip, a recorded skip; and it
never leaves a dataset behind that opens.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.data.domain import Domain
from qs3.data.store import is_finished, open_pointset, read_manifest
from qs3.errors import Qs3Error
from tests.data.test_domain import domain
from tests.fixtures import published as fixtures

SPLITS = {"train": 2, "test": 1}
READERS = ("depthscannet10", "shapenet10", "scannet10", "modelnet10_arrays")
"""A domain of each reader: text, .npy, HDF5 and .npz; others share them."""


@pytest.fixture(params=[*READERS, "own", "modelnet10_meshes"])
def made(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, list[Path]]:
    """Name, data folder, and the published files of a domain."""
    fixtures.write_domain(request.param, tmp_path, SPLITS)
    files = [p for p in sorted((tmp_path / "published").rglob("*")) if p.is_file()]
    return request.param, tmp_path, files


def refused(name: str, data_dir: Path, match: str, *overrides: str) -> None:
    """Opening fails with this message, again and again, and leaves nothing that opens."""
    for _ in range(2):
        found = domain(name, data_dir, *overrides)
        with pytest.raises(Qs3Error, match=match):
            found.open()
        assert not is_finished(found.folder)


def opened(name: str, data_dir: Path, *overrides: str) -> Domain:
    found = domain(name, data_dir, *overrides)
    found.open()
    return found


def test_truncated_files(made: tuple[str, Path, list[Path]]) -> None:
    """In their middle, where every format has lost something that it promises."""
    name, data_dir, files = made
    path = next(p for p in files if p.suffix not in (".txt",) or name == "own")
    data = path.read_bytes()
    cut = data[: len(data) // 2]
    if path.suffix in (".xyz", ".txt"):  # whole rows are lost unseen: cut within one
        cut = cut[: cut.rindex(b"\n") + 4]
    path.write_bytes(cut)
    refused(name, data_dir, path.name)
    path.write_bytes(b"")
    refused(name, data_dir, path.name)
    path.write_bytes(data)
    opened(name, data_dir)


@pytest.mark.parametrize("name", READERS)
def test_points_that_are_not_finite(name: str, tmp_path: Path) -> None:
    fixtures.write_domain(name, tmp_path, {"train": 2, "test": 2})
    files = sorted((tmp_path / "published").rglob("*"))
    path = next(p for p in files if p.is_file() and p.suffix != ".txt")
    if path.suffix == ".xyz":
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:5], "0.5 nan 1", *lines[6:]]) + "\n")
    elif path.suffix == ".npy":
        array = np.load(path)
        array[5, 1] = np.nan
        np.save(path, array)
    elif path.suffix == ".npz":
        with np.load(path) as file:
            arrays = dict(file)
        arrays["points"][0, 5, 1] = np.inf
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "a") as file:
            file["data"][4, 5, 1] = np.nan  # a chair
    refused(name, tmp_path, r"point 6.*not finite")
    skipped = opened(name, tmp_path, "published.on_error=skip")
    bad = [r for r in read_manifest(skipped.folder, skipped.names) if r.status != "ok"]
    assert len(bad) == 1
    assert "point 6" in bad[0].reason


@pytest.mark.parametrize(
    "name", ["depthscannet10", "own", "graspnetpc10_kinect", "modelnet10_meshes"]
)
def test_wrong_and_mixed_case_names(name: str, tmp_path: Path) -> None:
    fixtures.write_domain(name, tmp_path, SPLITS)
    root = tmp_path / "published" / ("modelnet40/raw" if name.endswith("meshes") else name)
    if name.startswith("graspnet"):
        root = tmp_path / "published" / "graspnetpc10" / "train" / "Real" / "kinect"
        (root / "3").rename(root / "ten")
        refused(name, tmp_path, "unknown class")
        return
    (root / "chair").rename(root / "Chair")
    (root / "sofa" / "train").rename(root / "sofa" / "TRAIN")
    first = opened(name, tmp_path).open()
    assert "chair" in {i.split("/")[0] for i in first.ids}
    shutil.rmtree(tmp_path / name)
    shutil.copytree(root / "Chair", root / "chair2")
    (root / "chair2").rename(root / "chair")
    if name == "own":  # sorted apart by the file's name: the same ids twice
        refused(name, tmp_path, "have one name")
    else:
        refused(name, tmp_path, "same class|have one name|twice|two folders")
    shutil.rmtree(root / "Chair")
    (root / "boat").mkdir()
    (root / "boat" / "train").mkdir()
    shutil.copy(next((root / "chair" / "train").iterdir()), root / "boat" / "train")
    if name.endswith("meshes"):  # other classes of ModelNet are left alone
        opened(name, tmp_path)
    else:
        refused(name, tmp_path, "boat")


@pytest.mark.parametrize("name", ["scannet10", "modelnet10_arrays", "graspnetpc10_kinect"])
def test_an_empty_class(name: str, tmp_path: Path) -> None:
    fixtures.write_domain(name, tmp_path, SPLITS)
    at = tmp_path / "published"
    if name == "scannet10":
        with h5py.File(at / name / "test_0.h5", "a") as file:
            file["label"][file["label"][...] == 4] = 5
    elif name == "modelnet10_arrays":
        with np.load(at / "modelnet10_points.npz") as file:
            arrays = dict(file)
        keep = (arrays["cls"] != "chair") | (arrays["split"] == "train")
        np.savez(at / "modelnet10_points.npz", **{k: v[keep] for k, v in arrays.items()})
    else:
        for path in (at / "graspnetpc10" / "test").rglob("4/*"):
            path.unlink()
    refused(name, tmp_path, r"split 'test' has no clouds of (chair|4)")


_OPEN = """
import resource, sys
from tests.data.test_domain import domain
from qs3.errors import Qs3Error
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    domain(sys.argv[1], sys.argv[2]).open()
except Qs3Error as error:
    print(error)
    sys.exit(3)
"""


def test_a_full_disk_leaves_nothing_that_opens(tmp_path: Path) -> None:
    """With a limit on the size of files, a write fails as it does on a full disk."""
    name = "scannet10"
    fixtures.write_domain(name, tmp_path, SPLITS)
    root = Path(__file__).parents[3]
    result = subprocess.run(
        [sys.executable, "-c", _OPEN, name, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert result.returncode == 3, result.stderr
    assert "cannot write" in result.stdout
    assert "free some space" in result.stdout
    assert not is_finished(tmp_path / name)
    data = opened(name, tmp_path).open()  # with room, the same command completes it
    assert open_pointset(tmp_path / name).sha256 == data.sha256


def test_scanobjectnn_leaves_out_other_classes_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fixtures.write_domain("scanobjectnn", tmp_path, SPLITS)
    data = opened("scanobjectnn", tmp_path).open()
    assert "24 clouds of other classes are left out" in caplog.text  # 8 classes of 3
    assert "split 'train' has no clouds of bathtub, lamp, plant" in caplog.text
    assert len(data) == 21
    path = tmp_path / "published" / "scanobjectnn" / "main_split" / "test_objectdataset.h5"
    with h5py.File(path) as file:
        raw = file["data"][6]  # a display, y up
    found = data.points[list(data.ids).index("monitor/test/test_objectdataset_00006")]
    np.testing.assert_array_equal(found, np.stack([raw[:, 0], -raw[:, 2], raw[:, 1]], 1))


def test_graspnet_takes_the_sensors_that_are_asked_for(tmp_path: Path) -> None:
    fixtures.write_domain("graspnetpc10", tmp_path, SPLITS)
    both = domain("graspnetpc10", tmp_path).open()
    assert set(both.splits) == {"train"}
    assert {i.split("/")[2].split("_")[0] for i in both.ids} == {"kinect", "realsense"}
    real = domain("graspnetpc10_realsense", tmp_path).open()
    assert {i.split("/")[2].split("_")[0] for i in real.ids} == {"realsense"}
    assert set(real.splits) == {"train", "test"}
    assert both.classes == real.classes == tuple("0123456789")
