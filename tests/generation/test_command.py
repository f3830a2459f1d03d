"""generate.py from a folder of small meshes, with real workers and the real renderer."""

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import trimesh
from PIL import Image

from qs3.errors import ConfigError, DataError, MissingDataError, RenderError
from qs3.generation.command import generate
from qs3.generation.recipes import Cloud
from qs3.generation.workers import Outcome, save_part
from qs3.store.meta import read_manifest
from qs3.store.parts import PartFiles
from qs3.store.store import open_pointset
from tests.generation.generating import ROOT, command, config, fingerprint


def test_a_folder_of_meshes_becomes_a_dataset(finished):
    folder, pointset = finished
    assert pointset.points.shape == (9, 2048, 3)
    assert pointset.counts()["train"]["chair"] == 2
    assert pointset.counts()["test"]["lamp"] == 1
    clean = open_pointset(folder, "points_clean")
    # The unit cube and a margin of 3 cm bound the scan; the twin lies in the cube itself.
    assert np.abs(pointset.points).max() <= np.sqrt(0.5) + 0.03 + 1e-6
    assert np.abs(clean.points).max() <= np.sqrt(0.5) + 1e-4
    assert not (folder / "parts").exists()
    versions = pointset.meta["versions"]
    assert versions["renderer"] == "mitsuba"
    assert {"variant", "mitsuba", "opencv", "numpy"} <= set(versions)


def test_the_number_of_workers_changes_no_byte(finished, meshes, tmp_path):
    generate(config(tmp_path, meshes, "workers=2"))
    assert fingerprint(tmp_path / "specklenet10") == fingerprint(finished[0])


def test_fewer_objects_are_the_same_objects(finished, meshes, tmp_path):
    _, whole = finished
    fewer = ("limit=1", "classes=[table,lamp]", "splits=[train]")
    part = generate(config(tmp_path, meshes, "workers=0", *fewer))
    assert part.ids == ("lamp/train/lamp_0", "table/train/table_0")
    for i, name in enumerate(part.ids):
        np.testing.assert_array_equal(part.points[i], whole.points[whole.ids.index(name)])


def test_a_finished_dataset_is_left_alone_and_other_settings_are_refused(finished, meshes):
    folder, _ = finished
    before = (folder / "points.npy").stat().st_mtime_ns
    generate(config(folder.parent, meshes, "workers=0"))
    assert (folder / "points.npy").stat().st_mtime_ns == before
    with pytest.raises(ConfigError, match=r"renderer\.samples"):
        generate(config(folder.parent, meshes, "workers=0", "renderer.samples=3"))


def test_force_deletes_nothing_where_the_renderer_cannot_start(finished, meshes, tmp_path):
    folder = tmp_path / "specklenet10"
    shutil.copytree(finished[0], folder)
    with pytest.raises(RenderError):
        generate(config(tmp_path, meshes, "workers=0", "force=true", "renderer.variant=scalar_x"))
    assert fingerprint(folder) == fingerprint(finished[0])


def test_a_resume_by_other_code_is_refused_and_a_finished_dataset_is_not_asked(
    meshes, tmp_path, monkeypatch
):
    def made(*more):
        few = ("workers=0", "classes=[chair]", *more)
        return generate(config(tmp_path, meshes, *few, domain="modelnet10"))

    with monkeypatch.context() as patch:
        stop = MagicMock(side_effect=KeyboardInterrupt)
        patch.setattr("qs3.generation.command.write_pointset", stop)
        with pytest.raises(KeyboardInterrupt):
            made()
    code = tmp_path / "modelnet10" / "parts" / "code.txt"
    own = code.read_text()
    for other in ("0" * 64, None):
        code.write_text(other) if other else code.unlink()
        with pytest.raises(ConfigError, match="another version"):
            made()
    code.write_text(own)
    first = made()
    assert not code.parent.exists()
    with monkeypatch.context() as patch:
        patch.setattr("qs3.generation.command.code_fingerprint", lambda: "another")
        assert made().sha256 == first.sha256
        assert made("force=true").sha256 == first.sha256


def test_meshes_that_are_gone_leave_an_unfinished_dataset(meshes, tmp_path, monkeypatch):
    """As where a network's disk is lost for a while."""
    mine, away = tmp_path / "meshes", tmp_path / "away"
    shutil.copytree(meshes, mine)
    whole = config(tmp_path, mine, "workers=0", "classes=[chair]", domain="modelnet10")

    def save_and_lose(parts, outcome):
        save_part(parts, outcome)
        if parts.count() == 1:
            mine.rename(away)

    with monkeypatch.context() as patch:
        patch.setattr("qs3.generation.command.save_part", save_and_lose)
        with pytest.raises(MissingDataError, match="2 of 3"):
            generate(whole)
    away.rename(mine)
    assert len(generate(whole).ids) == 3


def test_parts_without_a_recipe_are_not_taken_over(finished, meshes, tmp_path):
    parts = tmp_path / "specklenet10" / "parts"
    parts.mkdir(parents=True)
    cloud = Cloud({"points": np.ones((2048, 3), "f4")}, 1, 1)
    save_part(PartFiles(parts.parent), Outcome("chair/train/chair_0", "", cloud, ""))
    one = ("limit=1", "splits=[train]", "classes=[chair]")
    mine = generate(config(tmp_path, meshes, "workers=0", *one))
    np.testing.assert_array_equal(mine.points[0], finished[1].points[0])


def test_a_repaired_mesh_is_noticed(meshes, tmp_path):
    mine = tmp_path / "meshes" / "chair" / "train"
    mine.mkdir(parents=True)
    good = (meshes / "chair/train/chair_0.ply").read_bytes()
    for split in ("train", "test"):
        (mine.parent / split).mkdir(exist_ok=True)
        for i in range(2):
            (mine.parent / split / f"c{i}.ply").write_bytes(good)
    (mine / "c0.ply").write_bytes(good[:200])

    def made(*more):
        settings = ("workers=0", "classes=[chair]", *more)
        return generate(config(tmp_path, tmp_path / "meshes", *settings, domain="modelnet10"))

    first = made()
    assert len(first.ids) == 3
    row = read_manifest(tmp_path / "modelnet10")
    assert str(tmp_path) not in "".join(r.reason for r in row)
    (mine / "c0.ply").write_bytes(good)
    with pytest.raises(ConfigError, match="objects"):
        made()
    assert len(made("force=true").ids) == 4


def test_if_all_fail_nothing_is_left_in_the_way(meshes, tmp_path):
    one = ["workers=0", "splits=[test]", "classes=[chair]"]
    with pytest.raises(DataError):
        generate(config(tmp_path, meshes, *one, "recipe.min_points=1000000"))
    assert len(generate(config(tmp_path, meshes, *one)).ids) == 1


def test_broken_meshes_are_recorded_and_the_others_go_on(meshes, tmp_path):
    broken = tmp_path / "meshes"
    for path in meshes.rglob("*.ply"):
        copy = broken / path.relative_to(meshes)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    whole = (broken / "chair/train/chair_0.ply").read_bytes()
    (broken / "chair/train/chair_0.ply").write_bytes(whole[: len(whole) // 2])
    (broken / "table/train/table_1.ply").write_bytes(b"")
    (broken / "lamp/test/lamp_0.ply").unlink()
    (broken / "lamp/test/lamp_0.off").write_text("OFF\n3 1 0\nnan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")

    def made(*more):
        return generate(config(tmp_path, broken, "workers=1", *more, domain="modelnet10"))

    with pytest.raises(DataError):
        made("strict=true")
    pointset = made()  # is there
    assert len(pointset.ids) == 6
    rows = {r.id: r for r in read_manifest(tmp_path / "modelnet10")}
    for bad in ("chair/train/chair_0", "table/train/table_1", "lamp/test/lamp_0"):
        assert rows[bad].status == "failed"
        assert Path(bad).name in rows[bad].reason


def test_surface_samples_lie_on_the_surface_and_dropout_takes_regions(meshes, tmp_path):
    whole, holed = (
        generate(config(tmp_path, meshes, "workers=0", "classes=[lamp]", domain=domain))
        for domain in ("modelnet10", "modelnet10_dropout")
    )
    assert whole.ids == holed.ids
    directions = trimesh.creation.icosphere(3).vertices
    for clouds in zip(whole.points, holed.points, strict=True):
        for cloud in clouds:
            np.testing.assert_allclose(np.linalg.norm(cloud, axis=1), 0.5, atol=0.05)
        # The largest empty cap of a sphere: seen from somewhere, much is missing.
        gap = [
            np.degrees(np.arccos(np.clip((cloud / 0.5 @ directions.T).max(0), -1, 1))).max()
            for cloud in clouds
        ]
        assert gap[1] > gap[0] + 10


def test_a_finished_dataset_has_its_picture_and_config(finished, meshes):
    folder, pointset = finished
    assert np.asarray(Image.open(folder / "clouds.png").convert("RGB")).std() > 10
    assert f"data_dir: {folder.parent}" in (folder / "config.yaml").read_text()
    assert pointset.meta["config"]["classes"] == ["chair", "table", "lamp"]
    assert pointset.meta["config"]["test_fraction"] == 0.2
    assert str(folder.parent) not in (folder / "meta.yaml").read_text()


def test_force_takes_old_views_away(meshes, tmp_path):
    folder, few = tmp_path / "modelnet10", ("workers=0", "classes=[chair]")
    generate(config(tmp_path, meshes, *few, domain="modelnet10"))
    (folder / "views" / "chair").mkdir(parents=True)
    (folder / "mine.txt").write_text("kept")
    generate(config(tmp_path, meshes, *few, "force=true", domain="modelnet10"))
    assert {path.name for path in folder.iterdir()} == {
        ".lock", "clouds.png", "config.yaml", "manifest.csv", "meta.yaml", "mine.txt", "points.npy",
        "recipe.json",
    }  # fmt: skip
    assert len(open_pointset(folder)) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "more"), [(20_000, []), (420_000, ["scans=2"])], ids=["parts", "dataset"]
)
def test_files_that_cannot_grow_stop_the_run_and_a_resume_completes_it(
    meshes, tmp_path, limit, more
):
    """With a limit on the size of files, a write fails as it does on a full disk."""

    def run(largest_file):
        def limited():
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        words = command(tmp_path, meshes, "workers=1", *more)
        return subprocess.run(
            words, cwd=ROOT, capture_output=True, text=True, preexec_fn=limited, env=environment
        )

    stopped = run(limit)
    assert stopped.returncode != 0
    assert "failed:" not in stopped.stdout  # no object is blamed for it
    assert not (tmp_path / "specklenet10" / "meta.yaml").exists()
    again = run(resource.RLIM_INFINITY)
    assert again.returncode == 0, again.stderr
    generate(config(tmp_path / "whole", meshes, "workers=0", *more))
    whole = fingerprint(tmp_path / "whole" / "specklenet10")
    assert fingerprint(tmp_path / "specklenet10") == whole


@pytest.mark.slow
@pytest.mark.parametrize("keep", [[], ["keep_views=true", "provenance=true"]], ids=["", "views"])
@pytest.mark.parametrize("victim", ["parent", "worker"])
def test_kill_at_random_instants_changes_no_byte(meshes, tmp_path, victim, keep):
    """SIGKILL to the parent or to one of its workers, again and again, until it gets through."""
    generate(config(tmp_path / "whole", meshes, "workers=0", *keep))
    chance = random.Random(victim)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    kills = 0
    for _ in range(60):
        process = subprocess.Popen(
            command(tmp_path, meshes, "workers=2", *keep), cwd=ROOT, env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        # Early kills hit the start, later ones the writing; a start takes about 4 s.
        if kills < 12:
            time.sleep(chance.uniform(0.5, 8.0))
            kills += _kill(process.pid if victim == "parent" else _a_child(process.pid))
        if process.wait() == 0:
            if kills >= 10:
                break
            subprocess.run(["rm", "-rf", str(tmp_path / "specklenet10")], check=True)
    else:
        pytest.fail("it never finished")
    whole = {
        path.relative_to(tmp_path / "whole"): path.read_bytes()
        for path in (tmp_path / "whole").rglob("*")
        if path.is_file()
    }
    assert len(whole) == (8 if not keep else 9 + 9 * 2 * 2)
    for path, content in whole.items():
        if path.name != "config.yaml":  # with the folder
            assert (tmp_path / path).read_bytes() == content, path
    assert not list((tmp_path / "specklenet10").rglob("*.tmp*"))


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
