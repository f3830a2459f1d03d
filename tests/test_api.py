"""The commands as functions, on the toy problem that the notebooks use."""

import pytest
import torch
from hydra.core.hydra_config import HydraConfig

import qs3
from qs3.api import generate, train
from qs3.errors import ConfigError, DataError
from qs3.report.run_page import read_run
from qs3.runs.metrics import read_metrics
from qs3.tools.toy import SHAPES, ToyNet, toy_overrides, write_toy

SHORT = ["protocol.epochs=2", "selftraining.rounds=1", "selftraining.epochs=1"]
SHORT += ["selftraining.theta=0.1"]


def test_toy_is_the_same_each_time_and_as_it_says(tmp_path):
    source, target = write_toy(tmp_path / "a")
    again = write_toy(tmp_path / "b")
    assert (source.sha256, target.sha256) == (again[0].sha256, again[1].sha256)
    assert source.sha256 != write_toy(tmp_path / "c", seed=1)[0].sha256
    assert set(source.counts()["train"].values()) == {30}
    assert list(target.counts()["train"].values()) == [120, 30, 60, 30]
    weights = sum(p.numel() for p in ToyNet(4).parameters())
    assert 6000 < weights < 8000
    assert ToyNet(4)(torch.rand(5, 64, 3)).shape == (5, 4)


@pytest.mark.slow
def test_train_leaves_what_the_command_leaves(tmp_path):
    write_toy(tmp_path)
    folder = train(*toy_overrides(tmp_path), *SHORT, "seed=3")
    metrics = read_metrics(folder)
    assert (metrics.seed, metrics.source, metrics.simulated) == (3, "toy_source", True)
    assert (metrics.method, metrics.selftraining) == ("source_only", "qbst")  # as typed
    assert not HydraConfig.initialized()
    run = read_run(folder)
    assert run.config["protocol"]["epochs"] == 2
    assert run.command.startswith("python train.py experiment=quickstart")
    written = (folder / "metrics.json").stat().st_mtime_ns
    assert train(*toy_overrides(tmp_path), *SHORT, "seed=3") == folder  # not trained again
    assert (folder / "metrics.json").stat().st_mtime_ns == written
    assert qs3.load(folder, packages=("qs3",)).classes == tuple(SHAPES)
    with pytest.raises(DataError, match="refused"):
        qs3.load(folder)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (train, ["experiment=quickstart", "sead=1"]),
        (train, ["method=pmc"]),
        (train, ["data.nothing=1"]),
        (train, ["seed"]),
        (train, ["seed=[1"]),
        (train, ["seed=0,1"]),
        (train, ["hparams_search=optuna"]),
        (generate, ["domain=specklenet"]),
        (generate, ["chairs/a.off", "domain=specklenet10"]),
    ],
)
def test_wrong_words_are_errors_of_the_config(call, words):
    with pytest.raises(ConfigError):
        call(*words)


def test_generate(tmp_path):
    few = ["classes=[chair]", "catalogue.train=1", "catalogue.test=1", "workers=0"]
    made = generate("domain=modelnet10", *few, f"paths.data_dir={tmp_path}")
    assert made.ids == ("chair/train/chair_0000", "chair/test/chair_0000")
