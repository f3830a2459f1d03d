"""Through the domain, as a user has it: what only some formats have, and a disk that fills up."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.errors import DataError
from qs3.store.store import is_finished, open_pointset, read_manifest
from tests.datasets.test_domain import domain
from tests.fixtures import published as fixtures

SPLITS = {"train": 2, "test": 1}

_OPEN = """
import resource, sys
from tests.datasets.test_domain import domain
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
    data = domain(name, tmp_path).open()  # with room, the same command completes it
    assert open_pointset(tmp_path / name).sha256 == data.sha256


def test_scanobjectnn_leaves_out_other_classes_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fixtures.write_domain("scanobjectnn", tmp_path, SPLITS)
    data = domain("scanobjectnn", tmp_path).open()
    assert "24 clouds of other classes are left out" in caplog.text  # 8 classes of 3
    assert "split 'train' has no clouds of bathtub, lamp, plant" in caplog.text
    assert len(data) == 21
    path = tmp_path / "published" / "scanobjectnn" / "main_split" / "test_objectdataset.h5"
    with h5py.File(path) as file:
        raw = file["data"][6]  # a display, y up
    found = data.points[list(data.ids).index("monitor/test/test_objectdataset_00006")]
    np.testing.assert_array_equal(found, np.stack([raw[:, 0], -raw[:, 2], raw[:, 1]], 1))


def test_graspnet_takes_the_sensors_that_are_asked_for_and_stops_at_damage(tmp_path: Path) -> None:
    fixtures.write_domain("graspnetpc10", tmp_path, SPLITS)
    both = domain("graspnetpc10", tmp_path).open()
    assert set(both.splits) == {"train"}
    assert {i.split("/")[2].split("_")[0] for i in both.ids} == {"kinect", "realsense"}
    real = domain("graspnetpc10_realsense", tmp_path).open()
    assert {i.split("/")[2].split("_")[0] for i in real.ids} == {"realsense"}
    assert set(real.splits) == {"train", "test"}
    assert both.classes == real.classes == tuple("0123456789")

    # A damaged file stops the import, or is recorded.
    root = tmp_path / "published" / "graspnetpc10" / "train" / "Real" / "kinect"
    path = root / "3" / "scene_0003_0001.xyz"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], "0.5 nan 1", *lines[6:]]) + "\n")
    for _ in range(2):  # again and again
        found = domain("graspnetpc10_kinect", tmp_path)
        with pytest.raises(DataError, match=r"0003_0001\.xyz, point 6: .*not finite"):
            found.open()
        assert not is_finished(found.folder)
    data = domain("graspnetpc10_kinect", tmp_path, "published.on_error=skip").open()
    (bad,) = [r for r in read_manifest(found.folder, data.classes) if r.status != "ok"]
    assert bad.id == "3/train/kinect_scene_0003_0001"
    assert "point 6" in bad.reason
    (root / "3").rename(root / "ten")
    with pytest.raises(DataError, match="ten: unknown class"):
        domain("graspnetpc10_kinect", tmp_path, f"path={tmp_path}/other").open()
