"""The search: what it may look at, that it finds, goes on, and tries failures again."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from qs3.errors import ConfigError
from qs3.hydra_glue import build
from qs3.run import objective_of, train
from qs3.search import distribution
from qs3.selftraining.student_rules import OBJECTIVES, check_objective
from qs3.selftraining.validators import LABEL_FREE
from tests.sweeps.commands import command, light, light_runs
from tests.training.conftest import toy, toy_data  # noqa: F401 (fixtures)
from tests.training.toy import CONF, overrides

SEARCH = "hparams_search=qbst_optuna"


def table(text: str) -> list[list[str]]:
    """The rows of the trials: number, objective, parameters, run."""
    return [line.split() for line in text.splitlines() if re.match(r"\d+  +[-\d]", line)]


def search(folder, trials: int, *more: str):
    return light(folder, SEARCH, f"hydra.sweeper.trials={trials}", "hydra.sweeper.random=4", *more)


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
    (typed,) = re.findall(r"python train.py -m (.*)", result.stdout)
    assert typed.startswith("experiment=qs3_s2d ")
    assert typed.endswith(" seed=0,1,2")
    assert "optuna" not in typed
    assert f"selftraining.theta={rows[int(best)][2]}" in typed

    search(parts, 3)
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
    assert [row[0] for row in retried] == ["2", "3"]
    assert [row[2:5] for row in retried] == [row[2:5] for row in rows]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["objective=accuracy"], "objective=accuracy is refused"),
        (["objective=oracle"], "objective=oracle is refused"),
        (["selection.student=oracle"], "selection.student=oracle looks at the target's"),
        (["objective=pseudo_val"], "set selection.student=pseudo_val as well"),
        (["objective=null"], "a search needs an objective"),
        (["seed=0,1"], "tries each setting with one seed"),
        (["hydra.sweeper.trials=0"], "hydra.sweeper.trials must be"),
    ],
)  # fmt: skip
def test_what_is_refused(words, message, tmp_path):
    result = light(tmp_path, SEARCH, *words)
    assert result.returncode == 1
    assert message in result.stderr + result.stdout
    assert "Traceback" not in result.stderr
    assert light_runs(tmp_path) == {}


def test_objectives_are_label_free():
    assert set(OBJECTIVES) == {*LABEL_FREE, "pseudo_val"}
    check_objective(None, "oracle")
    check_objective("pseudo_val", "pseudo_val")


def test_a_run_refuses_the_objective_by_itself(toy):  # noqa: F811
    with pytest.raises(ConfigError, match="objective=accuracy is refused"):
        train(toy("objective=accuracy"))


def test_the_objective_is_what_the_validator_says(toy):  # noqa: F811
    """With rounds and without; by `selection.student` the last epoch's score is the same one."""
    metrics = train(toy("selection.student=infomax", "selftraining.epochs=1"))
    only = metrics["student"]["score"]  # one epoch to choose from, and it is reported
    assert metrics["validators"]["infomax"] == only
    assert set(metrics["validators"]) == set(LABEL_FREE)
    assert objective_of(toy("objective=infomax"), metrics) == only
    assert objective_of(toy(), metrics) is None

    metrics = train(toy("selection.student=pseudo_val"))
    assert metrics["validators"]["pseudo_val"] == metrics["student"]["score"]
    cfg = toy("selftraining=none", "objective=entropy")
    metrics = train(cfg)
    assert 0 <= objective_of(cfg, metrics) == metrics["validators"]["entropy"] <= 1.0987
    del metrics["validators"]
    with pytest.raises(ConfigError, match=r"no entropy under validators.*force=true"):
        objective_of(cfg, metrics)


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
    with pytest.raises(ConfigError, match=r"cannot search a=tag\(log,range"):
        distribution(parsed("tag(log,range(1,5))"))


@pytest.mark.parametrize("name", ["qbst_grid", "qbst_optuna"])
def test_configs_are_within_what_self_training_takes(name):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["experiment=qs3_s2d", f"hparams_search={name}"]
        cfg = compose("train", words, return_hydra_config=True)
        params = dict(cfg.hydra.sweeper.params)
        for end in (0, -1):
            chosen = []
            for key, text in params.items():
                values = re.findall(r"[\d.]+", text)
                chosen.append(f"{key}={values[:2][end] if '(' in text else values[end]}")
            build(compose("train", [*words, *chosen]).selftraining)  # raises if it is not
    text = (CONF / "hparams_search" / f"{name}.yaml").read_text().splitlines()
    assert text[1] == f"# python train.py -m experiment=qs3_s2d hparams_search={name}"


def test_the_grid_is_every_combination(tmp_path):
    """Of what the command line leaves open."""
    fixed = ["selftraining.rounds=6", "selftraining.epsilon=0.0,0.01"]
    result = light(tmp_path, "hparams_search=qbst_grid", *fixed)
    assert result.returncode == 0, result.stderr
    thetas = sorted(run["theta"] for run in light_runs(tmp_path).values())
    assert thetas == [0.6, 0.6, 0.7, 0.7, 0.8, 0.8]


@pytest.mark.slow
def test_a_search_with_trainings(tmp_path, toy_data):  # noqa: F811
    words = [
        *overrides(tmp_path, f"paths.data_dir={toy_data}"), SEARCH, "hydra.sweeper.trials=3",
        "hydra.sweeper.at_once=2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
    ]  # fmt: skip
    result = command(tmp_path, *words)
    assert result.returncode == 0, result.stderr
    assert len(table(result.stdout)) == 3
    assert "Best: trial" in result.stdout
