"""Domains as Hydra makes them from conf/domain, on fixtures in the published formats."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.utils import instantiate

from qs3.classes import CLASSES
from qs3.commands.download import scannet
from qs3.config.hydra import build
from qs3.datasets import domain as module
from qs3.datasets.domain import check_or_make
from qs3.errors import DataError, MissingDataError
from qs3.utils.commands import parse
from tests.composing import compose
from tests.fixtures import published as fixtures

CONF = Path(__file__).parents[2] / "conf"
PACKAGED = "source_sample"  # its files come with qs3
NAMES = sorted({path.stem for path in (CONF / "domain").glob("*.yaml")} - {PACKAGED})
SPLITS = {"train": 2, "test": 1}
FRAMES = ("nyuv2", "sunrgbd")  # of full size: one frame a pair of classes


def domain(name, data_dir, *overrides):
    """As train.py would mount it, in a config of our own."""
    mounted = [f"+domain@data.source={name}", "+paths=default", f"paths.data_dir={data_dir}"]
    added = [
        f"+data.source.{o[1:]}" if o.startswith("+") else f"data.source.{o}" for o in overrides
    ]
    cfg = compose(None, [*mounted, *added])
    return instantiate(cfg.data.source)


def test_what_comes_with_qs3_opens_without_more(tmp_path):
    found = domain(PACKAGED, tmp_path)
    found.check()
    data = found.open()
    assert data.classes == CLASSES
    counts = data.counts()["train"]
    assert min(counts.values()) > 15
    assert np.abs(data.points).max() < 6.5  # metres from a camera that sees 6 m
    assert data.points[..., 2].min() > -0.5  # on a floor
    found.check_scale("seen")


def test_fixtures_cover_every_domain():
    assert sorted(fixtures._writers(Path(), SPLITS, True)) == NAMES


# nyuv2: test_frames opens it on fewer frames
EACH = [pytest.param(n, marks=pytest.mark.slow if n == "nyuv2" else ()) for n in NAMES]


@pytest.mark.parametrize("name", EACH)
def test_every_domain_opens_on_its_fixture(tmp_path, name):
    splits = {"train": 1, "test": 1} if name in FRAMES else SPLITS
    fixtures.write_domain(name, tmp_path, splits)
    found = domain(name, tmp_path)
    found.check()
    data = found.open()
    counts, small = data.counts(), ("shapenet10", "graspnetpc10")
    both = 2 if name == "graspnetpc10" else 1  # sensors
    absent = {"bathtub", "lamp", "plant"} if name == "scanobjectnn" else set()
    assert data.classes == found.names
    assert (data.classes == CLASSES) == (name != "graspnetpc10")
    for split, each in (("train", splits["train"] * both), ("test", 1)):
        if (name, split) == ("graspnetpc10", "test"):
            assert split not in counts
            continue
        assert counts[split] == {c: 0 if c in absent else each for c in data.classes}
    assert data.points.shape[1:] == (1024 if name in small else 2048, 3)
    assert domain(name, tmp_path).open().sha256 == data.sha256


def test_clean_twin_beside_the_published_files_is_of_its_own(tmp_path):
    fixtures.write_domain("specklenet10", tmp_path, SPLITS)
    published = domain("specklenet10", tmp_path).open()
    with pytest.raises(MissingDataError) as error:  # the published dataset has no twin
        domain("specklenet10_clean", tmp_path).check()
    assert str(tmp_path / "specklenet10_clean/meta.yaml") in str(error.value)
    fixtures.write_domain("specklenet10_clean", tmp_path, SPLITS)
    clean = domain("specklenet10_clean", tmp_path).open()
    assert clean.made_of.objects == "a fixture"
    again = domain("specklenet10", tmp_path).open()
    assert (again.sha256, str(again.made_of)) == (published.sha256, "published files")


def test_changed_import_settings_are_noticed(tmp_path):
    fixtures.write_domain("scannet10", tmp_path, SPLITS)
    found = domain("scannet10", tmp_path)
    data = found.open()
    with pytest.raises(DataError):
        domain("scannet10", tmp_path, "published.form=mirrored", f"path={found.path}").open()
    mirrored = domain("scannet10", tmp_path, "published.form=mirrored").open()
    np.testing.assert_array_equal(mirrored.points * np.float32([1, -1, 1]), data.points)


def test_importing_is_light():
    code = (
        "import sys, qs3.datasets.domain\n"
        "heavy = {'torch', 'torch_geometric', 'h5py', 'lightning', 'scipy', 'matplotlib', 'rich'}\n"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("name", NAMES)
def test_missing_data_names_the_dataset_and_commands_that_compose(tmp_path, name):
    found = domain(name, tmp_path)
    with pytest.raises(MissingDataError) as caught:
        found.open()
    assert name in str(caught.value)
    assert str(found.folder / "meta.yaml") in str(caught.value)
    assert list(tmp_path.iterdir()) == []
    for command in filter(None, (found.make, found.stand_in)):
        assert command.split("#")[0].strip() in str(caught.value)
        _, script, *overrides = command.partition("#")[0].split()
        if script == "scannet":
            assert parse(scannet, overrides)[1]["out"] == found.folder
            continue
        cfg = compose("generate", overrides)
        assert cfg.paths.data_dir == str(tmp_path)
        build(cfg.domain)
        build(cfg.recipe)


def test_two_datasets_of_one_domain_are_refused(tmp_path):
    fixtures.write_domain("specklenet10", tmp_path, SPLITS)
    fixtures.write_store(tmp_path / "specklenet10", SPLITS)
    with pytest.raises(DataError):
        domain("specklenet10", tmp_path).check()
    with pytest.raises(DataError):
        domain("specklenet10", tmp_path).check_unpublished()
    made = domain("specklenet10", tmp_path, "published=null").open()
    assert made.made_of.objects == "a fixture"
    (tmp_path / "specklenet10").rename(tmp_path / "elsewhere")
    assert domain("specklenet10", tmp_path).open().made_of.published


def test_a_source_that_is_not_there_is_made_by_its_own_command(tmp_path, monkeypatch):
    asked = []

    def generate(words, check):
        asked.append(words)
        fixtures.write_domain("kinectsim10", tmp_path, SPLITS)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(module.subprocess, "run", generate)
    made, published = (domain(name, tmp_path) for name in ("kinectsim10", "scannet10"))
    with pytest.raises(MissingDataError):  # before minutes are spent on the source
        check_or_make(made, published, make_source=True)
    assert asked == []
    with pytest.raises(MissingDataError):
        check_or_make(made, made, make_source=False)
    fixtures.write_domain("scannet10", tmp_path, SPLITS)
    for _ in range(2):
        check_or_make(made, published, make_source=True)
    ((_, *words),) = asked
    assert words[-2:] == ["domain=kinectsim10", f"paths.data_dir={tmp_path}"]
    graspnet = domain("graspnetpc10", tmp_path)
    with pytest.raises(MissingDataError):  # nothing can make it
        check_or_make(graspnet, published, make_source=True)
