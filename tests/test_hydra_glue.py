"""Errors while building from the config, and what a multirun says at its end."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import pytest
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from qs3.errors import ConfigError
from qs3.hydra_glue import SummaryOfSeeds, build
from tests.report.runs import write_run


def refuses(value: int) -> int:
    raise ValueError(f"{value} is too small")


def fails() -> None:
    raise RuntimeError("a defect")


def node(**settings):
    return OmegaConf.create({"a": {"b": settings}}).a.b


def test_what_a_target_does_not_take_is_an_error_of_the_config():
    with pytest.raises(ConfigError, match=r"^a\.b: 3 is too small$"):
        build(node(_target_="tests.test_hydra_glue.refuses", value=3))
    with pytest.raises(ConfigError, match=r"^a\.b: .*unexpected keyword argument 'k'"):
        build(node(_target_="tests.test_hydra_glue.refuses", k=3))
    inner = {"_target_": "tests.test_hydra_glue.refuses", "value": 3}
    with pytest.raises(ConfigError, match=r"^a\.b\.value: 3 is too small$"):
        build(node(_target_="tests.test_hydra_glue.refuses", value=inner))


def test_our_own_errors_are_raised_as_they_were():
    with pytest.raises(ConfigError, match=r"^selftraining\.selector\.mu must be one of"):
        build(node(_target_="qs3.selftraining.selectors.Qbst", mu="two"))


def test_other_errors_keep_their_traceback():
    with pytest.raises(InstantiationException, match="a defect"):
        build(node(_target_="tests.test_hydra_glue.fails"))


def ended(summary: SummaryOfSeeds, folder, error: Exception | None = None) -> None:
    config = OmegaConf.create({"hydra": {"runtime": {"output_dir": str(folder)}}})
    summary.on_job_end(config, SimpleNamespace(_return_value=error, overrides=["seed=0"]))


@pytest.fixture
def summary():
    summary = SummaryOfSeeds()
    summary.on_multirun_start(OmegaConf.create())
    yield summary
    summary.on_multirun_end(OmegaConf.create())


def test_an_error_of_all_jobs_is_said_once(summary, tmp_path, caplog):
    with caplog.at_level(logging.ERROR):
        for seed, text in enumerate(["no data\nLooked for", "no data\nLooked for", "other", ""]):
            ended(summary, tmp_path / f"seed{seed}-ab", ValueError(text))
    assert [record.getMessage() for record in caplog.records] == [
        "seed=0 failed: no data", "seed=0 failed: other", "seed=0 failed: ValueError",
    ]  # fmt: skip


def test_no_table_without_a_finished_run(summary, tmp_path, capsys):
    ended(summary, tmp_path / "seed0-ab", ValueError("no data"))
    summary.on_multirun_end(OmegaConf.create())
    assert capsys.readouterr().out == ""


def test_finished_runs_make_a_table(summary, tmp_path, capsys):
    ended(summary, write_run(tmp_path, seed=0))
    ended(summary, tmp_path / "exp" / "seed1-0123abcd", ValueError("broken"))
    summary.on_multirun_end(OmegaConf.create())
    assert "seed 1: no result" in capsys.readouterr().out
