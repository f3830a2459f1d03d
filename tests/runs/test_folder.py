from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import config_hash, config_sha256, run_name
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.runs import folder as runs
from qs3.utils.files import owned
from tests.composing import compose

BASE = {
    "experiment_name": "x",
    "seed": 0,
    "force": False,
    "paths": {"data_dir": "data", "log_dir": "logs"},
    "data": {
        "points": 1024,
        "cache_dir": "cache",
        "source": {
            "name": "s",
            "title": "S",
            "path": "${paths.data_dir}/s",
            "variant": "points",
            "make": "do this",
            "published": {"folder": "published", "points": 2048},
        },
        "target": {"published": None},
    },
    "selftraining": {
        "_target_": "qs3.datamodules.phases.SelfTrainingConfig",
        "rounds": 2,
        "theta": 0.8,
    },
    "logger": {"csv": None},
    "callbacks": {"progress": {"enabled": True}},
}


def config(**changes):
    return OmegaConf.merge(
        OmegaConf.create(BASE), OmegaConf.from_dotlist([f"{k}={v}" for k, v in changes.items()])
    )


IGNORED = (
    *("seed", "force", "paths.data_dir", "logger.wandb", "callbacks.progress.enabled"),
    *("data.source.make", "data.source.synthesis", "data.cache_dir"),
    *(f"data.source.{name}" for name in ("path", "title", "symbol", "unit")),
    *(f"data.source.published.{name}" for name in ("folder", "file", "on_error")),
)
HASHED = (
    *("experiment_name", "data.points", "callbacks.mine", "selftraining.theta", "new_key"),
    *(f"data.source.{name}" for name in ("name", "variant", "published.points")),
)


@pytest.mark.parametrize("key", [*IGNORED, *HASHED])
def test_hash_sees_what_changes_the_result_and_nothing_else(key):
    same = config_hash(config(**{key: 7})) == config_hash(config())
    assert same == (key in IGNORED)


@pytest.mark.parametrize("none", [{"rounds": 0}, {"_target_": "qs3.datamodules.phases.no_rounds"}])
def test_hash_ignores_settings_of_rounds_that_there_are_not(none):
    changes = {f"selftraining.{key}": value for key, value in none.items()}
    expected = config_hash(config(**changes))
    assert expected != config_hash(config())
    assert config_hash(config(**changes, **{"selftraining.theta": 0.5})) == expected


def test_another_config_or_other_data_are_refused():
    whole = config_sha256(config())
    assert config_hash(config()) == whole[:8]
    runs.check_config(Path("run"), whole, whole)
    for other in (whole[:8] + "0" * 56, None):
        with pytest.raises(ConfigError, match="run"):
            runs.check_config(Path("run"), other, whole)
    runs.check_data(Path("run"), "source", whole, whole)
    with pytest.raises(DataError, match="source"):
        runs.check_data(Path("run"), "source", whole, "b" * 64)


def test_hash_does_not_depend_on_the_order_of_keys():
    backwards = OmegaConf.create(dict(reversed(BASE.items())))
    assert config_hash(backwards) == config_hash(config())


def test_what_a_run_was_started_with(tmp_path):
    assert runs.read_started(tmp_path) is None
    runs.write_started(tmp_path, {"config_sha256": "0" * 64})
    assert runs.read_started(tmp_path) == {"config_sha256": "0" * 64}
    for damaged in ("{", "[1]", "[" * 100_000):
        (tmp_path / runs.STARTED).write_text(damaged)
        with pytest.raises(DataError, match=r"started\.json"):
            runs.read_started(tmp_path)


def test_a_folder_that_another_process_owns(tmp_path):
    run = tmp_path / "run"
    with owned(run), pytest.raises(Qs3Error, match="run"), owned(run):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(Qs3Error), owned(tmp_path / "file/x"):
        pass


def test_clear_keeps_what_hydra_wrote(tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / "round_00").mkdir()
    for name in (".hydra/config.yaml", "round_00/x.csv", "train.log", "last.ckpt", "metrics.json"):
        (tmp_path / name).write_text(json.dumps({}))
    runs.clear(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hydra", "train.log"]


def test_which_commands_are_the_same_run():
    """The card that trains a run does not name it, and no search of its settings; ddp does."""
    whole, dann, searched, ddp, *gpus = (
        run_name(compose("train", ["experiment=qs3_s2d", *words]))
        for words in (
            *([], ["method=dann"], ["hparams_search=qbst_optuna"]),
            *(["trainer=gpu", "trainer.devices=2"], ["trainer=gpu"], ["trainer=gpus_in_turn"]),
            ["trainer=gpu", "trainer.devices=[3]"],
        )
    )
    assert re.fullmatch(r"qs3_s2d/seed0-[0-9a-f]{8}", whole)
    assert searched == whole
    assert len({*gpus}) == 1
    assert len({whole, dann, ddp, gpus[0]}) == 4
