"""The command itself, as a user types it: messages, multirun, what it imports."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import build
from qs3.training.run import run_of
from tests.running import command
from tests.training.conftest import result_of
from tests.training.toy import CONF, overrides

EXPERIMENTS = sorted(
    path.stem
    for path in (CONF / "experiment").glob("*.yaml")
    if "train.py" in path.read_text().splitlines()[1]
)


HEAVY = {"torch", "lightning", "scipy", "cv2", "matplotlib", "wandb", "bpy", "mitsuba"}
"""What takes a second and more to import, or a part of one."""


def imports_of(folder: Path, *arguments: str) -> tuple[set[str], subprocess.CompletedProcess]:
    """Names of all packages that the command imports; stderr is without the list."""
    result = command(folder, *arguments, PYTHONPROFILEIMPORTTIME="1")
    lines = result.stderr.splitlines()
    times = [line for line in lines if line.startswith("import time:")]
    assert len(times) > 100
    result.stderr = "\n".join(line for line in lines if not line.startswith("import time:"))
    return {line.rpartition("|")[2].strip().split(".")[0] for line in times}, result


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes(name):
    text = (CONF / "experiment" / f"{name}.yaml").read_text().splitlines()
    assert text[0] == "# @package _global_"
    assert text[1].startswith(f"# python train.py experiment={name} ")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", [f"experiment={name}"])
    assert cfg.experiment_name == name
    run_of(cfg)
    for node in (cfg.method, cfg.protocol.augment, cfg.protocol.optimizer):
        build(node)


def test_help_imports_nothing_heavy(tmp_path):
    """So it is there at once; tests/benchmarks/test_pipeline.py has the time."""
    imported, result = imports_of(tmp_path, "--help")
    assert result.returncode == 0
    assert not imported & HEAVY
    lines = result.stdout.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    for group in ("domain", "experiment", "logger", "method", "model", "selftraining", "trainer"):
        for path in (CONF / group).glob("*.yaml"):
            assert re.search(rf"\b{path.stem}\b", result.stdout), path
    (launchers,) = (line for line in lines if "hydra/launcher=" in line)
    for path in (CONF / "hydra" / "launcher").glob("*.yaml"):
        assert re.search(rf"\b{path.stem}\b", launchers), path


def test_missing_data_are_named_before_anything_heavy_is_imported(tmp_path):
    imported, result = imports_of(tmp_path, "experiment=qs3_s2d")
    assert not imported & HEAVY
    assert result.returncode == 1
    assert "MissingDataError" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
def test_ddp_is_refused_in_a_multirun(tmp_path, toy_data):
    words = overrides(tmp_path, f"paths.data_dir={toy_data}", "trainer.strategy=ddp", "seed=0,1")
    result = command(tmp_path, *words, "trainer.devices=2", "-m")
    assert result.returncode == 1
    assert "(DDP)" in result.stderr


@pytest.mark.slow
def test_multirun_then_one_seed(tmp_path, toy_data):
    arguments = overrides(tmp_path, f"paths.data_dir={toy_data}", "selftraining=none")
    sweep = command(tmp_path, *arguments, "report.pictures=auto", "seed=0,1", "-m")
    assert sweep.returncode == 0, sweep.stderr
    assert re.search(r"quickstart .* ± .* 2", sweep.stdout)
    assert "simulated" in sweep.stdout
    zero, one = sorted((tmp_path / "logs" / "quickstart").iterdir())
    assert (zero / ".hydra" / "config.yaml").is_file()
    assert not (zero / "wandb").exists()
    assert not (one / "pictures").exists()

    imported, again = imports_of(tmp_path, *arguments, "seed=1")
    assert not imported & HEAVY
    assert "already finished" in again.stdout
    own_logs = f"paths.log_dir={tmp_path / 'alone'}"
    imported, alone = imports_of(tmp_path, *arguments, "seed=1", own_logs)
    assert "wandb" not in imported
    assert alone.returncode == 0, alone.stderr
    (folder,) = (tmp_path / "alone" / "quickstart").iterdir()
    assert folder.name == one.name
    assert result_of(folder) == result_of(one)
