"""A source that is not there is made by its own command; nothing else is run."""

import numpy as np
import pytest

from qs3.config.location import python_command
from qs3.data import ensure_source as making
from qs3.data.domain import Domain
from qs3.data.ensure_source import make_if_missing
from qs3.data.store import is_finished
from qs3.errors import ConfigError, MissingDataError, Qs3Error
from qs3.training.command import train
from tests.training.toy import toy_config

FEW = "catalogue.train=2 catalogue.test=1 workers=0"


def domain(path, make):
    return Domain("modelnet10", "M", "ModelNet10", path / "modelnet10", make=make)


def test_made_once_and_again_only_if_it_is_gone(tmp_path, monkeypatch):
    one = domain(tmp_path, f"python generate.py domain=modelnet10 {FEW} paths.data_dir={tmp_path}")
    make_if_missing(one)
    assert is_finished(one.folder)
    assert len(one.open()) == 30

    def refuse(*words, **more):
        raise AssertionError(words)

    monkeypatch.setattr(making.subprocess, "run", refuse)
    make_if_missing(one)


@pytest.mark.parametrize("make", [None, "rm -rf x", "python train.py seed=1", "qs3 scannet x=1"])
def test_what_is_not_generated_is_refused(tmp_path, make):
    with pytest.raises(
        ConfigError, match="make_source=true, but domain modelnet10 is not generated"
    ):
        make_if_missing(domain(tmp_path, make))


def test_a_failure_says_so(tmp_path):
    with pytest.raises(Qs3Error, match="could not be made"):
        make_if_missing(
            domain(tmp_path, f"python generate.py no_such_key=1 paths.data_dir={tmp_path}")
        )


def test_a_run_makes_its_source_but_only_if_the_target_is_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = tmp_path / "data"
    make = f"python generate.py domain=modelnet10 {FEW} paths.data_dir={data}"
    words = [
        "selftraining=none", "domain@data.source=modelnet10", "domain@data.target=own",
        "data.make_source=true", f"data.source.make='{make}'", "num_classes=10",
        "data.target.published.layout=none", f"data.target.published.folder={tmp_path / 'scans'}",
    ]  # fmt: skip
    cfg = toy_config(tmp_path, *words)
    with pytest.raises(MissingDataError, match="domain own"):
        train(cfg)
    assert not (data / "modelnet10").exists()
    (tmp_path / "scans").mkdir()
    for i in range(8):
        cloud = np.random.default_rng(i).normal(size=(50, 3))
        np.save(tmp_path / "scans" / f"{i}.npy", cloud)
    assert train(cfg).source == "modelnet10"
    assert is_finished(data / "modelnet10")


def test_python_is_this_one(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(making.subprocess, "run", lambda words, check: seen.append(words) or Done())

    class Done:
        returncode = 0

    make_if_missing(domain(tmp_path, "python generate.py domain=modelnet10"))
    assert seen == [[*python_command("generate"), "domain=modelnet10"]]
