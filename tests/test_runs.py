from __future__ import annotations

import json

import pytest
from omegaconf import OmegaConf

from qs3 import runs
from qs3.errors import ConfigError, DataError, Qs3Error

BASE = {
    "experiment_name": "x",
    "seed": 0,
    "force": False,
    "paths": {"data_dir": "data", "log_dir": "logs"},
    "data": {
        "points": 1024,
        "source": {"path": "${paths.data_dir}/s", "variant": "points", "make": "do this"},
    },
    "logger": {"csv": None},
    "callbacks": {"progress": {"enabled": True}},
}


def config(**changes):
    return OmegaConf.merge(
        OmegaConf.create(BASE), OmegaConf.from_dotlist([f"{k}={v}" for k, v in changes.items()])
    )


@pytest.mark.parametrize(
    "key",
    [
        "seed",
        "force",
        "paths.data_dir",
        "logger.wandb",
        "callbacks.progress.enabled",
        "data.source.make",
        "data.source.synthesis",
    ],
)
def test_hash_ignores_what_does_not_change_the_result(key):
    assert runs.config_hash(config(**{key: 7})) == runs.config_hash(config())


@pytest.mark.parametrize(
    "key", ["experiment_name", "data.points", "data.source.variant", "callbacks.mine", "new_key"]
)
def test_hash_sees_everything_else(key):
    assert runs.config_hash(config(**{key: 7})) != runs.config_hash(config())


def test_hash_does_not_depend_on_the_order_of_keys():
    backwards = OmegaConf.create(dict(reversed(BASE.items())))
    assert runs.config_hash(backwards) == runs.config_hash(config())


def test_folder():
    folder = runs.run_folder(config(seed=3))
    assert folder.name == f"seed3-{runs.config_hash(config())}"
    assert folder.parent.name == "x"


@pytest.mark.parametrize("seed", [None, "1", 1.0, -1, True])
def test_seed_must_be_a_whole_number(seed):
    with pytest.raises(ConfigError, match="seed must be"):
        runs.check_seed(seed)


def test_seed_zero_is_a_seed():
    assert runs.check_seed(0) == 0


def test_metrics_mark_a_finished_run(tmp_path):
    assert runs.read_metrics(tmp_path) is None
    runs.write_metrics(tmp_path, {"status": "finished"})
    assert runs.read_metrics(tmp_path) == {"status": "finished"}
    (tmp_path / runs.METRICS).write_text("{")
    with pytest.raises(DataError, match="force=true"):
        runs.read_metrics(tmp_path)


def test_lock(tmp_path):
    with (
        runs.locked(tmp_path / "run"),
        pytest.raises(Qs3Error, match="another process"),
        runs.locked(tmp_path / "run"),
    ):
        pass
    with runs.locked(tmp_path / "run"):
        pass


def test_clear_keeps_what_hydra_wrote(tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / "round_00").mkdir()
    for name in (".hydra/config.yaml", "round_00/x.csv", "train.log", "last.ckpt", "metrics.json"):
        (tmp_path / name).write_text(json.dumps({}))
    runs.clear(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hydra", "train.log"]
