"""Every launcher: jobs are run, finished ones skipped, failures listed, GPUs taken in turn."""

from __future__ import annotations

import json
import re

import pytest
from hydra import compose, initialize_config_dir

from qs3.config.hydra import config_hash
from tests.running import command
from tests.sweeps.commands import light, light_runs
from tests.training.conftest import result_of
from tests.training.toy import CONF, overrides

LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra/launcher=submitit_local"],
    "ray": ["hydra/launcher=ray"],
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_gpus_in_turn_and_a_failure(launcher, tmp_path):
    """Three jobs on two GPUs, the first fails: the others run, and the failure is the last word."""
    words = ["trainer=gpus_in_turn", "trainer.gpus=2", "seed=9,1,2", *LAUNCHERS[launcher]]
    result = light(tmp_path, *words)
    assert result.returncode == 1
    found = light_runs(tmp_path)
    assert {name[:5]: run["devices"] for name, run in found.items()} == {
        "seed1": [1], "seed2": [0],
    }  # fmt: skip
    with initialize_config_dir(str(CONF), version_base="1.3"):
        one_gpu = compose("train", ["experiment=qs3_s2d", "trainer=gpu"])
    assert {run["hash"] for run in found.values()} == {config_hash(one_gpu)}
    if launcher == "submitit_local":
        assert len({run["pid"] for run in found.values()}) == 2
        assert len(list(tmp_path.glob("logs/.submitit/*/*_log.out"))) == 3

    assert "Traceback" not in result.stderr
    _, error, job = result.stdout[result.stdout.index("1 of 3 jobs failed:") :].splitlines()
    assert error == "  SelectionError: round 0: nothing is selected"
    assert re.fullmatch(r" +experiment=qs3_s2d .*seed=9  \(/.*/logs/qs3_s2d/seed9-\w{8}\)", job)
    assert not list((tmp_path / "logs").glob(".multirun-*"))


@pytest.mark.slow
def test_a_job_of_rays_whose_process_is_killed_begins_again(tmp_path):
    """Once is made good, three times is listed; neither harms the others."""
    result = light(tmp_path, "seed=6,8,1", "hydra/launcher=ray", "hydra.launcher.jobs=1")
    assert result.returncode == 1
    assert "1 of 3 jobs failed:\n  did not end: killed" in result.stdout
    assert re.search(r"seed=8  \(/", result.stdout)
    assert {name[:5]: run["times"] for name, run in light_runs(tmp_path).items()} == {
        "seed1": 1, "seed6": 1,
    }  # fmt: skip
    assert "Traceback" not in result.stderr


@pytest.mark.slow
def test_listed_jobs(tmp_path):
    """Any jobs, numbered through."""
    jobs = [["selftraining.theta=0.5"], ["seed=9"], ["method=dann", "seed=4"]]
    (tmp_path / "jobs.json").write_text(json.dumps(jobs))
    words = ["hydra/sweeper=listed", f"hydra.sweeper.file={tmp_path / 'jobs.json'}"]
    result = light(tmp_path, *words, "trainer=gpus_in_turn", "trainer.gpus=9")
    assert result.returncode == 1
    assert "1 of 3 jobs failed" in result.stdout
    assert sorted(run["devices"] for run in light_runs(tmp_path).values()) == [[0], [2]]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_trainings(launcher, tmp_path, toy_data):
    """Two seeds train, another setting selects nothing; again, the finished ones are skipped."""
    words = [
        *overrides(tmp_path, f"paths.data_dir={toy_data}", *LAUNCHERS[launcher]),
        "selftraining.theta=0.4,0.9999", "seed=0,1", "--multirun",
    ]  # fmt: skip
    first = command(tmp_path, *words)
    assert first.returncode == 1
    assert re.search(r"quickstart .* ± .* 2", first.stdout)
    assert "2 of 4 jobs failed:\n  SelectionError: " in first.stdout
    finished = sorted(path.parent for path in tmp_path.glob("logs/quickstart/*/metrics.json"))
    assert [folder.name.split("-")[0] for folder in finished] == ["seed0", "seed1"]
    before = {folder: (result_of(folder), written(folder)) for folder in finished}
    assert command(tmp_path, *words).returncode == 1
    assert before == {folder: (result_of(folder), written(folder)) for folder in finished}

    alone = [word for word in words[:-1] if not word.startswith(("selftraining.theta", "hydra"))]
    alone = [*alone[:-1], "selftraining.theta=0.4", "seed=1", f"paths.log_dir={tmp_path / 'alone'}"]
    assert command(tmp_path, *alone).returncode == 0
    (folder,) = (tmp_path / "alone" / "quickstart").iterdir()
    assert result_of(folder) == before[finished[1]][0]


def written(folder) -> int:
    return (folder / "metrics.json").stat().st_mtime_ns
