"""Domains as Hydra makes them from conf/domain, on fixtures in the published formats."""

import multiprocessing
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate

from qs3.classes import CLASSES
from qs3.datasets.domain import Domain, check_all
from qs3.datasets.importers import XyzTree
from qs3.datasets.scannet.cli import SCANNET
from qs3.errors import ConfigError, DataError, MissingDataError
from tests.composing import compose
from tests.fixtures import published as fixtures

CONF = Path(__file__).parents[2] / "conf"
PACKAGED = "source_sample"  # its files come with qs3
NAMES = sorted({path.stem for path in (CONF / "domain").glob("*.yaml")} - {PACKAGED})
SPLITS = {"train": 2, "test": 1}


GRASPNET = ("graspnetpc10", "graspnetpc10_kinect", "graspnetpc10_realsense")
FORTY = ("specklenet40", "modelnet40_meshes")
# Classes that cannot be generated, or what is yours to name.
WITHOUT_STAND_IN = (*GRASPNET, "modelnet40_meshes", "joined")


def domain(name, data_dir, *overrides):
    """As train.py would mount it, in a config of our own."""
    mounted = [f"+domain@data.source={name}", "+paths=default", f"paths.data_dir={data_dir}"]
    cfg = compose(None, [*mounted, *(f"data.source.{o}" for o in overrides)])
    return instantiate(cfg.data.source)


def test_what_comes_with_qs3_opens_without_more(tmp_path):
    found = domain(PACKAGED, tmp_path)
    found.check()
    data = found.open()
    assert data.classes == CLASSES
    counts = data.counts()["train"]
    assert min(counts.values()) > 30
    assert np.abs(data.points).max() < 4  # metres
    assert data.points[..., 2].min() > -0.5  # on a floor
    found.check_scale("above_floor")


def test_fixtures_cover_every_domain():
    assert sorted(fixtures._writers(Path(), SPLITS, True)) == NAMES


@pytest.mark.parametrize("name", ["scannet10", "scanobjectnn", "modelnet40_meshes"])
def test_files_that_lie_deeper_are_pointed_to(tmp_path, name):
    """As an archive unpacks that has a folder of its own; only what is looked for was said."""
    fixtures.write_domain(name, tmp_path, SPLITS)
    root = domain(name, tmp_path).importer().root
    inner = root / "archive" / "PointDA_data"
    root.rename(tmp_path / "unpacked")
    inner.parent.mkdir(parents=True)
    (root / "empty").mkdir()
    (tmp_path / "unpacked").rename(inner)
    with pytest.raises(MissingDataError) as caught:
        domain(name, tmp_path).check()
    line = f"\nSuch files lie deeper, in {inner}: move what it holds to {root}\n"
    assert line in str(caught.value)
    shutil.rmtree(inner)
    with pytest.raises(MissingDataError) as caught:
        domain(name, tmp_path).check()
    assert "lie deeper," not in str(caught.value)


def test_a_tree_that_lies_deeper_is_pointed_to(tmp_path):
    fixtures.write_domain("shapenet10", tmp_path, SPLITS)
    root = domain("shapenet10", tmp_path).importer().root
    root.rename(tmp_path / "unpacked")
    root.mkdir()
    (tmp_path / "unpacked").rename(root / "shapenet")
    message = rf"unknown class 'shapenet'; .*; {root}/shapenet holds them: move them to {root}$"
    with pytest.raises(DataError, match=message):
        domain("shapenet10", tmp_path).open()


@pytest.mark.parametrize("name", NAMES)
def test_missing_data_is_explained(tmp_path, name):
    found = domain(name, tmp_path)
    with pytest.raises(MissingDataError) as caught:
        found.check()
    message = str(caught.value)
    assert message.startswith(f"domain {name}: {found.label} is not there. Looked for:\n")
    assert str(found.folder / "meta.yaml") in message
    assert "Where to get it: " in message
    if found.make or found.stand_in:
        assert "python generate.py domain=" in message
        assert f"paths.data_dir={tmp_path}" in message
    else:
        assert name in WITHOUT_STAND_IN
    assert ("simulated" in found.label) == name.startswith("kinectsim10")
    with pytest.raises(MissingDataError):
        found.open()
    assert list(tmp_path.iterdir()) == []
    for command in filter(None, (found.make, found.stand_in)):  # each of them composes
        python, script, *overrides = command.partition("#")[0].split()
        if python == "qs3":
            assert script == "scannet"
            assert SCANNET.parse(overrides)["out"] == found.folder
            continue
        assert (python, script) == ("python", "generate.py")
        cfg = compose("generate", overrides)
        assert cfg.paths.data_dir == str(tmp_path)
        instantiate(cfg.domain)
        instantiate(cfg.recipe)


@pytest.mark.parametrize("name", NAMES)
def test_every_domain_opens_on_its_fixture(tmp_path, name):
    fixtures.write_domain(name, tmp_path, SPLITS)
    found = domain(name, tmp_path)
    found.check()
    data = found.open()
    counts, small = data.counts(), ("shapenet10", "modelnet10_arrays", *GRASPNET)
    both = 2 if name == "graspnetpc10" else 1  # sensors
    absent = {"bathtub", "lamp", "plant"} if name == "scanobjectnn" else set()
    assert data.classes == found.names
    assert (data.classes == CLASSES) == (name not in (*GRASPNET, *FORTY))
    for split, each in (("train", 2 * both), ("test", 1)):
        if (name, split) == ("graspnetpc10", "test"):
            assert split not in counts
            continue
        assert counts[split] == {c: 0 if c in absent else each for c in data.classes}
    assert data.points.shape[1:] == (1024 if name in small else 2048, 3)
    assert domain(name, tmp_path).open().sha256 == data.sha256


def test_published_counts_are_compared(tmp_path, caplog):
    fixtures.write_domain("scannet10", tmp_path, SPLITS)
    for _ in range(2):  # after the import, and whenever it is opened
        caplog.clear()
        domain("scannet10", tmp_path).open()
        (record,) = (r for r in caplog.records if "published numbers" in r.message)
        assert record.levelname == "WARNING"
        assert "ScanNet10 (S*)" in record.message
        assert "train bathtub 2 instead of 98" in record.message
        assert "test table 1 instead of 301" in record.message
    exact = [f"expected_counts.{s}={[n] * 10}" for s, n in SPLITS.items()]
    caplog.clear()
    domain("scannet10", tmp_path, *exact).open()
    assert "published numbers" not in caplog.text
    (tmp_path / "published").rename(tmp_path / "away")
    (tmp_path / "scannet10").rename(tmp_path / "imported")
    fixtures.write_store(tmp_path / "scannet10", SPLITS)  # a generated one was never published
    domain("scannet10", tmp_path).open()
    assert "published numbers" not in caplog.text


def test_a_store_of_other_classes_is_refused(tmp_path):
    fixtures.write_domain("own", tmp_path, SPLITS)
    domain("own", tmp_path).open()
    with pytest.raises(DataError, match=r"made with the classes bathtub, .*says cup, box"):
        domain("own", tmp_path, "classes=[cup,box]").open()


def test_clean_twin_is_the_same_objects(tmp_path):
    fixtures.write_domain("specklenet10", tmp_path, SPLITS, published=False)
    noisy = domain("specklenet10", tmp_path).open()
    clean = domain("specklenet10_clean", tmp_path).open()
    assert noisy.ids == clean.ids
    assert noisy.sha256 != clean.sha256
    assert 0.001 < np.abs(noisy.points - clean.points).mean() < 0.01


def test_two_datasets_of_one_domain_are_refused(tmp_path):
    fixtures.write_domain("specklenet10", tmp_path, SPLITS)
    fixtures.write_store(tmp_path / "specklenet10", SPLITS)
    with pytest.raises(DataError) as error:
        domain("specklenet10", tmp_path).check()
    said = str(error.value)
    assert f"in {tmp_path / 'specklenet10'} one that was made here (a fixture)" in said
    assert f"in {tmp_path / 'published' / 'specklenet10'} the published files" in said
    assert "delete or rename the first folder" in said
    assert "data.source.published=null" in said
    made = domain("specklenet10", tmp_path, "published=null").open()
    assert made.made_of.objects == "a fixture"
    (tmp_path / "specklenet10").rename(tmp_path / "elsewhere")
    assert domain("specklenet10", tmp_path).open().made_of.published


def test_clean_twin_beside_the_published_files_is_of_its_own(tmp_path):
    fixtures.write_domain("specklenet10", tmp_path, SPLITS)
    published = domain("specklenet10", tmp_path).open()
    with pytest.raises(MissingDataError) as error:  # the published dataset has no twin
        domain("specklenet10_clean", tmp_path).check()
    for place in ("specklenet10_clean/meta.yaml", "specklenet10/points_clean.npy"):
        assert str(tmp_path / place) in str(error.value)
    fixtures.write_domain("specklenet10_clean", tmp_path, SPLITS)
    clean = domain("specklenet10_clean", tmp_path).open()
    assert clean.made_of.objects == "a fixture"
    again = domain("specklenet10", tmp_path).open()
    assert (again.sha256, str(again.made_of)) == (published.sha256, "published files")


def test_incomplete_published_files_do_not_count_as_published(tmp_path):
    fixtures.write_domain("modelnet10", tmp_path, SPLITS)
    found = domain("modelnet10", tmp_path)
    assert str(found.made_of(found.open())) == "published files, in other numbers"
    exact = [f"expected_counts.{s}={[n] * 10}" for s, n in SPLITS.items()]
    found = domain("modelnet10", tmp_path, *exact)
    assert found.made_of(found.open()).published


def test_changed_import_settings_are_noticed(tmp_path):
    fixtures.write_domain("scannet10", tmp_path, SPLITS)
    data = domain("scannet10", tmp_path).open()
    with pytest.raises(
        DataError, match=r"\{'undo_mirror': True\}, the config says \{'undo_mirror'"
    ):
        domain("scannet10", tmp_path, "published.undo_mirror=false").open()
    mirrored = domain(
        "scannet10", tmp_path, "published.undo_mirror=false", f"path={tmp_path}/mirrored"
    ).open()
    np.testing.assert_array_equal(mirrored.points * np.float32([1, -1, 1]), data.points)


def test_published_files_may_be_put_away_after_the_import(tmp_path):
    fixtures.write_domain("modelnet10", tmp_path, SPLITS)
    first = domain("modelnet10", tmp_path).open()
    (tmp_path / "published").rename(tmp_path / "attic")
    assert domain("modelnet10", tmp_path).open().sha256 == first.sha256


def test_unfinished_generation_names_the_command_to_continue(tmp_path):
    (tmp_path / "kinectsim10").mkdir()
    (tmp_path / "kinectsim10" / "part").write_text("")
    with pytest.raises(MissingDataError, match=r"(?s)begun but not finished.*Continue making it"):
        domain("kinectsim10", tmp_path).check()


def test_a_place_that_was_named_is_told_first_and_has_no_stand_in(tmp_path):
    def said(name, key, place):
        with pytest.raises(MissingDataError) as caught:
            domain(name, tmp_path / "data", f"published.{key}={place}").check()
        assert "python generate.py" not in str(caught.value)
        return str(caught.value).splitlines()[0].removeprefix(f"domain {name}: ")

    (empty := tmp_path / "empty").mkdir()
    (cloud := tmp_path / "a.xyz").write_text("0 0 0\n")
    (tmp_path / "empty" / "notes.md").write_text("")
    nowhere = tmp_path / "nope"
    assert said("own", "folder", nowhere).startswith(f"there is no folder {nowhere}; own clouds")
    assert said("own", "folder", empty).startswith(f"{empty} holds no cloud of .xyz .txt .npy")
    assert said("own", "folder", cloud).startswith(f"{cloud} is a file; give the folder that")
    assert said("objects", "file", nowhere).startswith(f"there is no file {nowhere}; archive of")
    assert said("scannet10", "folder", nowhere).startswith(f"there is no folder {nowhere}; Scan")
    assert said("scannet10", "folder", empty).startswith(f"{empty} holds nothing of what")


def test_all_that_is_missing_is_told_at_once(tmp_path):
    names = ("specklenet10", "depthscannet10", "depthscannet10")
    with pytest.raises(MissingDataError) as caught:
        check_all(*(domain(name, tmp_path) for name in names))
    assert str(caught.value).count("is not there. Looked for:") == 2
    fixtures.write_domain("specklenet10", tmp_path, SPLITS)
    with pytest.raises(MissingDataError, match=r"^domain depthscannet10"):
        check_all(*(domain(name, tmp_path) for name in names))


def _open(data_dir):
    return Domain(
        "d", "D", "D", data_dir / "d", published=XyzTree(data_dir / "published" / "depthscannet10")
    ).open().sha256  # fmt: skip


def test_processes_that_open_at_once_import_once(tmp_path):
    fixtures.write_domain("depthscannet10", tmp_path, SPLITS)
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        assert len(set(pool.map(_open, [tmp_path] * 3))) == 1
    assert not (tmp_path / ".d.importing").exists()


def test_wrong_settings():
    with pytest.raises(ConfigError, match="variant is 'noisy'"):
        Domain("d", "D", "D", "d", variant="noisy")
    with pytest.raises(ConfigError, match="gravity is 'y'"):
        Domain("d", "D", "D", "d", gravity="y")
    with pytest.raises(ConfigError, match="empty or twice"):
        Domain("d", "D", "D", "d", classes=["cup", "cup"])
    said = r"expected_counts\.train has 2 numbers for 10 classes: .* or expected_counts=null"
    with pytest.raises(ConfigError, match=said):
        Domain("d", "D", "D", "d", expected_counts={"train": [1, 2]})
    bad = {"_target_": "qs3.datasets.importers.XyzTree", "folder": "x", "points": 0}
    with pytest.raises(ConfigError, match="`published` is wrong"):
        Domain("d", "D", "D", "d", published=bad).check()


def test_importing_is_light():
    code = (
        "import sys, qs3.datasets.domain\n"
        "heavy = {'torch', 'torch_geometric', 'h5py', 'lightning', 'scipy', 'matplotlib', 'rich'}\n"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
