"""From rendered rooms in ScanNet's formats to clouds on their objects."""

import csv
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from qs3.datasets.domain import Domain
from qs3.datasets.scannet import extract
from qs3.datasets.scannet_scene import Extraction
from qs3.errors import ConfigError, DataError
from qs3.report.datasets import distance_to_mesh
from qs3.store.store import read_manifest
from qs3.utils.pool import Processes
from tests.datasets.conftest import LOST
from tests.datasets.rooms import write_lists, write_scene
from tests.datasets.writing import ID_OF, write_zip
from tests.fixtures.published import write_store
from tests.running import main

ROOT = Path(__file__).resolve().parents[2]
SMALL = Extraction(min_points=600)
TRAIN, VAL, NEITHER = "scene0001_00", "scene0007_01", "scene0100_00"


def run(root, out, settings=SMALL, **more):
    return extract(
        scans=root / "scans", labels=root / "labels.tsv", train=root / "train.txt",
        val=root / "val.txt", out=out, settings=settings, **more,
    )  # fmt: skip


def contents(folder):
    """Hash of every file that is not hidden, by its name in the folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


def copy(written, to):
    shutil.copytree(written, to)
    return to


def scenes(out):
    with open(out / "scenes.csv") as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def finished(written, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "depthscannet10"
    return out, run(written, out)


def test_every_object_of_the_ten_classes_is_found_and_no_other(finished):
    out, pointset = finished
    assert pointset.ids == (
        f"chair/train/{TRAIN}_2", f"chair/test/{VAL}_2",
        f"sofa/train/{TRAIN}_4", f"sofa/test/{VAL}_4",
        f"table/train/{TRAIN}_5", f"table/test/{VAL}_5",
    )  # fmt: skip
    assert pointset.points.shape == (6, 2048, 3)
    assert pointset.counts()["train"]["chair"] == pointset.counts()["test"]["sofa"] == 1
    rows = read_manifest(out, pointset.classes)
    assert rows[0].origin.startswith(f"scene {TRAIN}, object 2, label 'chairs', frames 0 ")
    assert all(1 < row.views <= 10 for row in rows)
    assert Domain("depthscannet10", "D", "DepthScanNet10", out).open().sha256 == pointset.sha256
    assert pointset.meta["simulated"] is False
    assert pointset.meta["extraction"]["min_points"] == 600


def test_each_cloud_lies_on_its_object(finished, recorded):
    """Depth is stored in millimetres: half of one, along the ray, is all the error there is."""
    _, pointset = finished
    for name, cloud in zip(pointset.ids, pointset.points, strict=True):
        scene, number = name.split("/")[2].rsplit("_", 1)
        mesh = recorded[scene][0].bodies[int(number)].mesh
        assert distance_to_mesh(cloud, mesh).max() < 0.00055, name
        # Seen from 200 degrees about it, the cloud reaches the object's extent, and z is up.
        low, high = mesh.bounds
        assert cloud[:, 2].max() > high[2] - 0.03
        assert (np.ptp(cloud, axis=0) > 0.85 * (high - low)).all(), name


def test_frames_without_a_pose_are_never_used(finished):
    out, pointset = finished
    for row in read_manifest(out, pointset.classes):
        frames = row.origin.split("frames ")[1].split(",")[0].split()
        assert not {int(frame) for frame in frames} & set(LOST)
        assert len(frames) == row.views
    table = scenes(out)
    assert set(table) == {TRAIN, VAL}  # the third is in neither list
    assert table[TRAIN]["frames"] == "14"
    assert table[TRAIN]["frames_lost"] == "2"
    assert table[TRAIN]["frames_used"] == "12"


def test_the_second_call_finds_it_finished(finished, written):
    out, pointset = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.name != ".lock"}
    assert run(written, out).sha256 == pointset.sha256
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with pytest.raises(ConfigError):
        run(written, out, Extraction(min_points=600, views=5))


def test_the_number_of_workers_changes_no_byte(finished, written, tmp_path):
    out, _ = finished
    run(written, tmp_path / out.name, pool=Processes(2))
    assert contents(tmp_path / out.name) == contents(out)


@pytest.mark.slow
def test_an_object_that_is_nowhere_large_enough_is_skipped_with_the_reason(written, tmp_path):
    run(written, tmp_path, Extraction(min_points=5000))
    rows = {row.id: row for row in read_manifest(tmp_path, ("chair", "sofa", "table"))}
    chair = rows[f"chair/train/{TRAIN}_2"]
    assert chair.status == "skipped"
    assert rows[f"sofa/train/{TRAIN}_4"].status == "ok"
    with pytest.raises(DataError):
        run(written, tmp_path / "none", Extraction(min_points=10**6))


def test_a_broken_recording_fails_its_scene_alone_and_is_tried_again(written, finished, tmp_path):
    root = copy(written, tmp_path / "in")
    path = root / "scans" / VAL / f"{VAL}.sens"
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    out = tmp_path / finished[0].name
    pointset = run(root, out)
    assert set(pointset.splits) == {"train"}
    table = scenes(out)
    assert table[VAL]["status"] == "failed"
    assert f"{VAL}/{VAL}.sens" in table[VAL]["notes"]
    assert str(root) not in table[VAL]["notes"]
    path.write_bytes(whole)
    run(root, out)
    assert contents(out) == contents(finished[0])


def test_scenes_that_come_later_are_added(written, finished, tmp_path):
    root = copy(written, tmp_path / "in")
    (root / "scans" / TRAIN).rename(tmp_path / "later")
    out = tmp_path / finished[0].name
    assert len(run(root, out)) == 3
    (tmp_path / "later").rename(root / "scans" / TRAIN)
    run(root, out)
    assert contents(out) == contents(finished[0])
    shutil.rmtree(out / "parts")  # as one may when all is there
    assert len(run(root, out)) == 6
    assert not (out / "parts").exists()


@pytest.mark.slow
def test_other_files_or_another_split_make_a_scene_anew(written, recorded, tmp_path):
    root, out = copy(written, tmp_path / "in"), tmp_path / "d"
    run(root, out)
    write_scene(root / "scans", TRAIN, *recorded[VAL])  # downloaded again, and not the same
    run(root, out)
    run(root, tmp_path / "fresh" / "d")
    assert contents(out) == contents(tmp_path / "fresh" / "d")
    write_lists(root, [VAL], [TRAIN])
    swapped = run(root, out)
    assert f"chair/train/{VAL}_2" in swapped.ids
    assert f"chair/test/{TRAIN}_2" in swapped.ids


def test_what_a_scene_lacks_is_told(written, tmp_path):
    root = copy(written, tmp_path / "in")
    (root / "scans" / VAL / f"{VAL}.aggregation.json").unlink()
    shutil.rmtree(root / "scans" / TRAIN)
    for suffix in (".aggregation.json", "_2d-instance-filt.zip", ".sens"):
        (root / "scans" / VAL / f"{VAL}{suffix}").unlink(missing_ok=True)
        with pytest.raises(DataError):
            run(root, tmp_path / "out")


def test_without_label_masks_the_aggregation_is_believed(written, finished, tmp_path):
    root = copy(written, tmp_path / "in")
    for scene in (TRAIN, VAL):
        (root / "scans" / scene / f"{scene}_2d-label-filt.zip").unlink()
    pointset = run(root, tmp_path / "out")
    assert pointset.sha256 == finished[1].sha256
    assert "no label masks" in scenes(tmp_path / "out")[VAL]["notes"]


def test_label_masks_that_deny_the_class_are_heeded(written, finished, recorded, tmp_path):
    """All of the chair is a lamp there, and a strip of the sofa is a wall."""
    root = copy(written, tmp_path / "in")
    made, _, masks = recorded[TRAIN]
    lut = np.zeros(256, np.uint16)
    for number, word in made.words.items():
        lut[number + 1] = ID_OF[word]
    labels = {}
    for frame, mask in masks.items():
        labels[frame] = lut[mask]
        labels[frame][mask == 2 + 1] = ID_OF["lamp"]
        strip = mask[150:170] == 4 + 1
        labels[frame][150:170][strip] = ID_OF["wall"]
    write_zip(root / "scans" / TRAIN / f"{TRAIN}_2d-label-filt.zip", "label-filt", labels)
    run(root, tmp_path / "out")
    rows = {row.id: row for row in read_manifest(tmp_path / "out", ("chair", "sofa", "table"))}
    chair = rows[f"chair/train/{TRAIN}_2"]
    assert chair.status == "skipped"
    assert "give it another class" in chair.reason
    sofa = rows[f"sofa/train/{TRAIN}_4"]
    assert sofa.status == "ok"
    before = next(r for r in read_manifest(finished[0], finished[1].classes) if r.id == sofa.id)
    assert sofa.origin == before.origin  # the same frames, without the strip
    assert 0 < before.valid_points - sofa.valid_points < 0.3 * before.valid_points


@pytest.mark.slow
def test_force_starts_over_and_a_strange_folder_is_refused(written, finished, tmp_path):
    out = tmp_path / finished[0].name
    run(written, out, Extraction(min_points=600, views=2, stride=2))
    for row in read_manifest(out, finished[1].classes):
        frames = [int(n) for n in row.origin.split("frames ")[1].split(",")[0].split()]
        assert len(frames) <= 2
        assert all(frame % 2 == 0 for frame in frames)
    run(written, out, force=True)
    assert contents(out) == contents(finished[0])
    imported = tmp_path / "imported"
    write_store(imported, {"train": 1})
    before = contents(imported)
    with pytest.raises(DataError):
        run(written, imported, force=True)
    assert contents(imported) == before


def test_the_command(written, finished, tmp_path, capsys):
    out = tmp_path / finished[0].name
    words = [
        "scannet", f"scans={written}/scans", f"labels={written}/labels.tsv",
        f"train={written}/train.txt", f"val={written}/val.txt", f"out={out}",
        "min_points=600", "workers=0",
    ]  # fmt: skip
    assert main(words) == 0
    assert contents(out) == contents(finished[0])
    assert main([*words, "views=3"]) == 1
    assert "ConfigError" in capsys.readouterr().err
    assert main([*words, "engine=slurm", "engine.cluser=local"]) == 1
    assert "engine=slurm: " in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["parent", "worker"])
def test_kill_at_random_instants_changes_no_byte(recorded, tmp_path, victim):
    """SIGKILL again and again, until it gets through."""
    names = [f"scene{i:04d}_00" for i in range(12)]
    one, other = recorded.values()
    for i, name in enumerate(names):
        write_scene(tmp_path / "scans", name, *(one if i % 2 else other))
    write_lists(tmp_path, names[:8], names[8:])
    out = tmp_path / "killed" / "d"
    run(tmp_path, tmp_path / "whole" / "d", SMALL)
    whole = contents(tmp_path / "whole" / "d")
    assert len(whole) == 12 + 5
    command = [
        sys.executable, "-m", "qs3", "scannet", f"scans={tmp_path}/scans", f"out={out}",
        f"labels={tmp_path}/labels.tsv", f"train={tmp_path}/train.txt",
        f"val={tmp_path}/val.txt", "workers=2", "min_points=600",
    ]  # fmt: skip
    chance = random.Random(victim)
    kills = 0
    for _ in range(60):
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if kills < 12:
            time.sleep(chance.uniform(0.3, 3.5))
            kills += _kill(process.pid if victim == "parent" else _a_child(process.pid))
        if process.wait(timeout=120) == 0:  # a hung run is a failure, too
            assert contents(out) == whole
            if kills >= 10:
                break
            subprocess.run(["rm", "-rf", str(out)], check=True)
    else:
        pytest.fail("it never finished")
    assert not list(out.rglob("*.tmp*"))


def _a_child(pid):
    found = Path(f"/proc/{pid}/task/{pid}/children")
    children = found.read_text().split() if found.exists() else []
    return int(children[-1]) if children else None


def _kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except (ProcessLookupError, TypeError):
        return 0
    return 1
