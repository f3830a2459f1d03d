"""What a multirun says at its end."""

from __future__ import annotations

import logging
import pickle
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from qs3.sweeps.summary import SummaryOfSeeds, failures
from tests.report.made_runs import write_run


def config(folder: Path, *overrides: str, num: int = 0):
    hydra = {
        "runtime": {"output_dir": str(folder)},
        "overrides": {"task": list(overrides)},
        "run": {"dir": str(folder)},
        "sweep": {"dir": str(folder)},
        "job": {"num": num},
    }
    return OmegaConf.create({"hydra": hydra})


def ended(summary: SummaryOfSeeds, folder, error: Exception | None = None, seed: int = 0) -> None:
    job = SimpleNamespace(_return_value=error, overrides=[f"seed={seed}"])
    summary.on_job_start(config(folder, f"seed={seed}"))
    summary.on_job_end(config(folder), job)


@pytest.fixture
def summary(tmp_path):
    summary = SummaryOfSeeds()
    summary.on_multirun_start(config(tmp_path))
    yield summary
    summary.on_multirun_end(config(tmp_path))
    assert not list(tmp_path.glob(".multirun*"))


def test_an_error_of_all_jobs_is_said_once(summary, tmp_path, caplog):
    with caplog.at_level(logging.ERROR):
        for seed, text in enumerate(["no data\nLooked for", "no data\nLooked for", "other", ""]):
            ended(summary, tmp_path / f"seed{seed}-ab", ValueError(text))
    assert [record.getMessage() for record in caplog.records] == [
        "seed=0 failed: ValueError: no data", "seed=0 failed: ValueError: other",
        "seed=0 failed: ValueError: ",
    ]  # fmt: skip


def test_the_table_says_in_what_its_lines_differ(tmp_path, capsys):
    summary = SummaryOfSeeds()
    summary.on_multirun_start(config(tmp_path))
    hashes = {"0.5": "cccccccc", "0.45": "aaaaaaaa", "0.4": "bbbbbbbb"}
    for num, (theta, sha) in reversed(list(enumerate(hashes.items()))):  # as workers take them
        for seed in (0, 1):
            words = ["experiment=quickstart", f"selftraining.theta={theta}", f"seed={seed}"]
            folder = tmp_path / "exp" / f"seed{seed}-{sha}"
            if theta != "0.4":
                write_run(tmp_path, seed=seed, hash=sha)
            else:
                (folder / ".hydra").mkdir(parents=True)
            job = SimpleNamespace(_return_value=None, overrides=words)
            summary.on_job_start(config(folder, *words, num=2 * num + seed))
            summary.on_job_end(config(folder, num=2 * num + seed), job)
    summary.on_multirun_end(config(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:2] == ["experiment", "settings"]
    assert [line.split()[1] for line in lines[3:6]] == [
        f"selftraining.theta={theta}" for theta in hashes
    ]  # in the sweep's order, also the one that is not finished
    assert "experiment=quickstart" not in "".join(lines)  # what all have in common


def test_no_table_without_a_finished_run(summary, tmp_path, capsys):
    ended(summary, tmp_path / "seed0-ab", ValueError("no data"))
    summary.on_multirun_end(config(tmp_path))
    assert capsys.readouterr().out == (
        f"1 of 1 jobs failed:\n  ValueError: no data\n    seed=0  ({tmp_path / 'seed0-ab'})\n"
    )


def test_a_job_that_never_ended(summary, tmp_path, capsys):
    ended(summary, write_run(tmp_path, seed=0))
    summary.on_job_start(config(tmp_path / "exp" / "seed1-0123abcd", "seed=1"))
    summary.on_multirun_end(config(tmp_path))
    out = capsys.readouterr().out.splitlines()
    assert out[-3] == "1 of 2 jobs failed:"
    assert out[-1].startswith("    seed=1  (")


def test_a_job_is_the_same_whether_what_it_names_is_resolved(summary, tmp_path, capsys):
    """A table's cells have such overrides; each would count twice, once as one without an end."""
    words = ["data.source.path=${paths.data_dir}/cad10", "seed=0"]
    begun = config(tmp_path / "exp" / "seed0-0123abcd", *words)
    begun.paths = {"data_dir": "data"}
    summary.on_job_start(begun)
    summary.on_job_end(begun, SimpleNamespace(_return_value=None, overrides=words))
    summary.on_multirun_end(config(tmp_path))
    assert "failed" not in capsys.readouterr().out


def test_a_job_that_ends_after_the_summary_leaves_nothing_behind(summary, tmp_path, caplog):
    """In a process of its own, on a cluster, when the main process was stopped by Ctrl-C."""
    late = pickle.loads(pickle.dumps(summary))
    late.on_job_start(config(tmp_path / "late", "seed=1"))
    summary.on_multirun_end(config(tmp_path))
    job = SimpleNamespace(_return_value=ValueError("late"), overrides=["seed=1"])
    late.on_job_end(config(tmp_path / "late"), job)
    assert "seed=1 failed: ValueError: late" in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_failures_are_grouped_by_error():
    def job(name, **more):
        return {"folder": f"/logs/{name}", "overrides": [f"a={name}"], **more}

    jobs = [job(3, error="x"), job(1, error="y"), job(2, error=""), job(4), job(0, error="x")]
    lines = failures(jobs).splitlines()
    assert lines[:4] == ["4 of 5 jobs failed:", "  x", "    a=0  (/logs/0)", "    a=3  (/logs/3)"]
    assert lines[-1] == "    a=4  (/logs/4)"
    assert failures([job(2, error="")]) == ""
