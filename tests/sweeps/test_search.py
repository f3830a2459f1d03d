"""The search: what it may look at, that it finds, goes on, and tries failures again."""

from __future__ import annotations

import json
import logging
import math
import re
import shlex

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import OmegaConf

from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.sweeps.search import Tried, check_varied, distribution, report, split, words
from qs3.training.command import judged, objective_of, train
from qs3.utils.files import locked
from tests.running import command
from tests.sweeps.commands import light, light_runs
from tests.training.toy import CONF, overrides, write_domain

SEARCH = "hparams_search=qbst_optuna"
GRID = "objective=infomax"
PARSER = OverridesParser.create(
    config_loader=ConfigLoaderImpl(create_config_search_path(str(CONF)))
)


def table(text: str) -> list[list[str]]:
    """The rows of the trials: number, objective, parameters, run."""
    return [line.split() for line in text.splitlines() if re.match(r"\d+  +[-\d]", line)]


def search(folder, trials: int, *more: str):
    return light(folder, SEARCH, f"hydra.sweeper.trials={trials}", "hydra.sweeper.random=4", *more)


@pytest.mark.slow
def test_it_finds_goes_on_and_is_repeatable(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder in (whole, parts):
        folder.mkdir()
    result = search(whole, 9)
    assert result.returncode == 0, result.stderr
    rows = table(result.stdout)
    assert [int(row[0]) for row in rows] == list(range(9))
    values = [float(row[1]) for row in rows]
    assert np.mean(values[4:]) > np.mean(values[:4])  # those are drawn at random
    assert "Accuracy" not in result.stdout
    (best,) = re.findall(r"Best: trial (\d+)", result.stdout)
    assert values[int(best)] == max(values)
    (typed,) = re.findall(r"qs3-train -m (.*)", result.stdout)
    assert typed.startswith("experiment=qs3_s2d ")
    assert typed.endswith(" seed=0,1,2")
    assert "optuna" not in typed
    assert f"selftraining.theta={rows[int(best)][2]}" in typed

    search(parts, 3)
    (lock,) = (parts / "logs" / "searches").glob(".*.lock")
    with locked(lock, "held twice"):  # by a search that is still running: its trials are its own
        result = search(parts, 9)
    assert result.returncode == 1
    assert "another process is searching in" in result.stderr
    assert "Traceback" not in result.stderr
    result = search(parts, 9)
    assert table(result.stdout) == rows  # as if it had never been interrupted
    assert all(run["times"] == 1 for run in light_runs(parts).values())
    assert result.stdout.count("Launching") == 6
    with initialize_config_dir(str(CONF), version_base="1.3"):
        compose("train", typed.replace("seed=0,1,2", "seed=0").split())


@pytest.mark.slow
def test_failures_are_listed_and_tried_again(tmp_path):
    """Two at a time by joblib; the seed is what fails."""
    more = ["hydra.sweeper.at_once=2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    broken = search(tmp_path, 4, "seed=9", *more)
    assert broken.returncode == 1
    assert "2 of 2 jobs failed" in broken.stdout  # a search whose first trials all fail stops
    rows = [line.split() for line in broken.stdout.splitlines() if line.endswith("  failed")]
    assert [row[:2] for row in rows] == [["0", "-"], ["1", "-"]]
    again = search(tmp_path, 4, "seed=9", *more)
    retried = [line.split() for line in again.stdout.splitlines() if line.endswith("  failed")]
    assert retried == rows


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        (SEARCH, ["objective=null"]),
        # A plain sweep; that these keys may not vary is tested below.
        pytest.param(GRID, ["data.points=256,512"], marks=pytest.mark.slow),
    ],
)
def test_unfair_searches_are_refused_before_a_job(sweep, words, tmp_path):
    result = light(tmp_path, sweep, *words)
    assert result.returncode == 1
    assert "ConfigError" in result.stderr + result.stdout
    assert light_runs(tmp_path) == {}


@pytest.mark.parametrize(
    "word",
    [
        *("objective=null,infomax", "seed=range(0,3)", "selection.teacher=last,source_val"),
        *("selection={teacher:last},{teacher:given}", "data.sampler=choice(shuffled,balanced)"),
        *("domain@data.target=kinectsim10,depthscannet10", "model@data.target=a,b"),
        *("+experiment=qs3_s2d,quickstart", "methods=a,b"),
    ],
)
def test_keys_that_do_not_vary(word):
    key, _, value = word.partition("=")
    for arguments, params in (([word, "method=dann,pcm"], {}), ([], {key: value})):
        _, varied = split(arguments, params, PARSER)
        with pytest.raises(ConfigError, match=re.escape(word)):
            check_varied(varied.values())


def test_what_may_vary():
    arguments = ["method=dann,pcm", "model=choice(dgcnn,pointnet)", "data.points=512", "a=1"]
    arguments += ["protocol.batch_size=8,16"]
    fixed, varied = split(arguments, {"a": "1,2", "b": 3, "selftraining.theta": "0.1,0.2"}, PARSER)
    assert fixed == ["data.points=512", "a=1", "b=3"]
    assert list(varied) == ["method", "model", "protocol.batch_size", "selftraining.theta"]
    check_varied(varied.values())


def test_the_objective_is_what_the_validator_says(toy):
    metrics = train(toy())
    assert objective_of(toy("objective=infomax"), metrics) == metrics.infomax > 0
    assert objective_of(toy(), metrics) is None


def test_a_run_that_really_diverges_is_finished_and_has_none(toy):
    cfg = toy("selftraining=none", "protocol.optimizer.lr=1e30", "objective=infomax")
    metrics = train(cfg)
    assert metrics.infomax is None
    assert metrics.final.calibration_error is None
    assert math.isnan(objective_of(cfg, metrics))
    assert judged(cfg, metrics).endswith("none: the net has diverged")


def test_a_trial_says_its_objective_and_no_accuracy(toy, caplog):
    """Nor when it was finished before; metrics.json has all."""
    words = ["selftraining=none", "protocol.epochs=1"]
    with caplog.at_level(logging.INFO):
        train(toy(*words, "objective=infomax"))
        train(toy(*words, "objective=infomax"))
    assert "accuracy" not in caplog.text.lower()
    assert len(re.findall(r"objective=infomax \d\.\d{4}", caplog.text)) == 2


def parsed(text: str):
    return OverridesParser.create().parse_override(f"a={text}")


def test_distributions():
    real = distribution(parsed("interval(0.5,0.9)"))
    assert (real.low, real.high, real.log) == (0.5, 0.9, False)
    log = distribution(parsed("tag(log,interval(1e-4,1e-2))"))
    assert (log.low, log.high, log.log) == (1e-4, 1e-2, True)
    whole = distribution(parsed("range(2,13,2)"))
    assert (whole.low, whole.high, whole.step) == (2, 12, 2)
    steps = distribution(parsed("range(0.5,0.91,0.1)"))
    assert (steps.low, steps.high, steps.step) == (0.5, 0.9, 0.1)
    assert distribution(parsed("interval(1,5)")).high == 5
    assert distribution(parsed("choice(qbst,'spst')")).choices == ("qbst", "spst")
    assert distribution(parsed("true,false")).choices == (True, False)


@pytest.mark.parametrize("text", ["x,y", "a b", "1", "null", "it's", "[x]", "plain", "f(x)"])
def test_a_choice_reaches_the_run_as_it_was_typed(text):
    """Also text that Hydra would read as a sweep, a number or a list."""
    sweep = parsed(f"{QuotedString(text, Quote.single).with_quotes()},2,null,true")
    choices = distribution(sweep).choices
    assert choices == (text, 2, None, True)
    read = [parsed(words({"a": one})["a"]) for one in choices]
    assert [one.value() for one in read] == list(choices)
    assert not any(one.is_sweep_override() for one in read)


def test_the_search_is_within_what_self_training_takes():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["experiment=qs3_s2d", SEARCH]
        cfg = compose("train", words, return_hydra_config=True)
    params = dict(cfg.hydra.sweeper.params)
    for end in (0, -1):
        for key, text in params.items():
            values = re.findall(r"[\d.]+", text)
            OmegaConf.update(cfg, key, json.loads(values[:2][end] if "(" in text else values[end]))
        build(cfg.selftraining)  # raises if it is not


@pytest.mark.slow
def test_the_grid_is_every_combination(tmp_path):
    """Every combination of what the command line leaves open; it ends with each objective."""
    fixed = [
        "selftraining.rounds=6",
        "selftraining.theta=0.6,0.69",
        "selftraining.epsilon=0.0,0.01",
    ]
    result = light(tmp_path, GRID, *fixed, "hydra.sweeper.max_batch_size=3")
    assert result.returncode == 0, result.stderr
    thetas = sorted(run["theta"] for run in light_runs(tmp_path).values())
    assert thetas == [0.6, 0.6, 0.69, 0.69]
    rows = table(result.stdout)
    assert [row[:4] for row in rows] == [
        ["0", "-0.0100", "0.6", "0.0"], ["1", "-0.0100", "0.6", "0.01"],
        ["2", "-0.0001", "0.69", "0.0"], ["3", "-0.0001", "0.69", "0.01"],
    ]  # fmt: skip
    assert {row[4].removeprefix("qs3_s2d/") for row in rows} == set(light_runs(tmp_path))
    assert "accuracy" not in result.stdout.lower()
    assert "infomax, which needs no labels, of each run" in result.stdout
    (typed,) = re.findall(r"Best: trial 2\..*\n  qs3-train -m (.*)", result.stdout)
    words = typed.split()
    assert set(words) == {
        "experiment=qs3_s2d", "selftraining.rounds=6", "selftraining.epsilon=0.0",
        "selftraining.theta=0.69", "seed=0,1,2",
    }  # fmt: skip
    thetas = "selftraining.theta=0.6,0.69,0.8"
    result = light(tmp_path, GRID, thetas, "seed=7")  # what diverged is listed
    assert result.returncode == 0
    lost = [row[1] == "-" for row in table(result.stdout)]
    assert lost == [float(row[2]) > 0.695 for row in table(result.stdout)]
    assert "  diverged: qs3_s2d/seed7-" in result.stdout


@pytest.mark.slow
def test_a_run_that_diverged_is_a_bad_trial_and_no_failure(tmp_path):
    """It is listed, is not tried again, and the search goes on."""
    result = search(tmp_path, 3, "seed=7")
    assert result.returncode == 0, result.stderr
    lost = [line.split() for line in result.stdout.splitlines() if "  diverged: qs3_s2d/" in line]
    rows = [row for row in table(result.stdout) if row[1] != "-"]
    assert 0 < len(lost) < 3
    assert len(rows) == 3 - len(lost)
    assert all(float(row[2]) > 0.695 for row in lost)
    assert all(float(row[2]) < 0.695 for row in rows)
    assert "failed" not in result.stdout
    again = search(tmp_path, 3, "seed=7")
    assert again.returncode == 0
    assert table(again.stdout) == table(result.stdout)
    assert "Launching" not in again.stdout


def test_the_best_trial():
    """The first of the best; none where all diverged."""
    tried = [Tried(i, {"a": f"'{i},'"}, value, f"r/{i}") for i, value in enumerate([2, 3, 3, 1])]
    fixed = ["hparams_search=x", "experiment=e", "objective=infomax", "seed=4", "b=c d"]
    text = report("T", "infomax", tried, fixed).splitlines()
    assert text[0] == "T"
    assert text[-2] == "Best: trial 1. With several seeds:"
    typed = shlex.split(text[-1])[3:]
    assert typed == ["experiment=e", "b=c d", "a='1,'", "seed=0,1,2"]


@pytest.mark.slow
def test_a_search_with_trainings(tmp_path, toy_data):
    words = [
        *overrides(tmp_path, f"paths.data_dir={toy_data}"), SEARCH, "hydra.sweeper.trials=3",
        "hydra.sweeper.at_once=2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
    ]  # fmt: skip
    result = command(tmp_path, *words)
    assert result.returncode == 0, result.stderr
    assert len(table(result.stdout)) == 3
    assert "Best: trial" in result.stdout
    console = (result.stdout + result.stderr).lower()
    assert "accura" not in console
    assert "balanced" not in console
    assert len(re.findall(r"quickstart, seed 0: objective=infomax \d\.\d{4}", console)) == 3
    for name in ("specklenet10", "kinectsim10"):
        write_domain(tmp_path / "others", name, noise=0.2)
    words[words.index(f"paths.data_dir={toy_data}")] = f"paths.data_dir={tmp_path / 'others'}"
    result = command(tmp_path, *words)  # objectives of two datasets are none of one study
    assert result.returncode == 1
    assert "another version of specklenet10" in result.stderr
    assert "Best: trial" not in result.stdout
