"""A source that is not there is made by its own command; nothing else is run."""

from types import SimpleNamespace

import pytest

from qs3.config.location import python_command
from qs3.datasets import ensure_source as making
from qs3.datasets.domain import Domain
from qs3.datasets.ensure_source import check_or_make, make_if_missing
from qs3.errors import ConfigError, MissingDataError, Qs3Error
from qs3.store.store import is_finished
from tests.fixtures.published import write_store

FEW = "catalogue.train=2 catalogue.test=1 workers=0"


def domain(path, make, name="modelnet10"):
    return Domain(name, "M", "ModelNet10", path / name, make=make)


@pytest.fixture
def commands(monkeypatch):
    """What would be run."""
    seen = []

    def run(words, check):
        seen.append(words)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(making.subprocess, "run", run)
    return seen


def test_a_missing_source_is_made(tmp_path):
    one = domain(tmp_path, f"python generate.py domain=modelnet10 {FEW} paths.data_dir={tmp_path}")
    make_if_missing(one)
    assert is_finished(one.folder)
    assert len(one.open()) == 30


@pytest.mark.parametrize("make", [None, "rm -rf x", "python train.py seed=1", "qs3 scannet x=1"])
def test_what_is_not_generated_is_refused(tmp_path, make, commands):
    with pytest.raises(
        ConfigError, match="make_source=true, but domain modelnet10 is not generated"
    ):
        make_if_missing(domain(tmp_path, make))
    assert commands == []


def test_a_failure_says_so(tmp_path):
    with pytest.raises(Qs3Error, match="could not be made"):
        make_if_missing(
            domain(tmp_path, f"python generate.py no_such_key=1 paths.data_dir={tmp_path}")
        )


def test_only_a_source_that_is_gone_and_only_if_the_target_is_there(tmp_path, commands):
    source = domain(tmp_path, "python generate.py domain=modelnet10")
    target = domain(tmp_path, "python generate.py domain=own", "own")
    with pytest.raises(MissingDataError, match="domain own"):
        check_or_make(source, target, make_source=True)
    assert commands == []
    write_store(tmp_path / "own")
    with pytest.raises(MissingDataError, match="domain modelnet10"):
        check_or_make(source, target, make_source=False)
    assert commands == []
    with pytest.raises(MissingDataError, match="domain modelnet10"):  # nothing was really made
        check_or_make(source, target, make_source=True)
    assert commands == [[*python_command("generate"), "domain=modelnet10"]]
    write_store(tmp_path / "modelnet10")
    check_or_make(source, target, make_source=True)
    assert len(commands) == 1
