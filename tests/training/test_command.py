"""The command itself, as a user types it: messages, multirun, what it imports."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import build
from qs3.training.settings import KEYS
from qs3.training.settings import _check_keys as check_keys_of
from qs3.utils.locks import owned
from tests.running import command
from tests.training.conftest import result_of, toy_data  # noqa: F401 (a fixture)
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
    for node in (cfg.selftraining, cfg.data.source, cfg.data.target, cfg.method):
        build(node)
    build(cfg.protocol.augment)
    build(cfg.protocol.optimizer)
    check_keys_of(cfg)


def test_keys_that_are_read_are_those_of_the_files():
    """Also one of a user's own that other values are made of."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", ["+short=3", "protocol.epochs=${short}", "debug=fast"])
    check_keys_of(cfg)
    assert set(cfg) - {"short"} == set(KEYS[""])
    for key in ("protocol", "selection", "evaluation"):
        assert set(cfg[key]) == set(KEYS[f"{key}."])


def test_help_imports_nothing_heavy(tmp_path):
    """So it is there at once; tests/benchmarks/test_command_speed.py has the time."""
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


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), ("specklenet10", "meta.yaml", "qs3-generate")),  # no generate.py is here
        (("method=supervised",), ("ConfigError", "set selftraining=none")),
        (("data.source=modelnet10",), ("ConfigError: data.source must", "domain@data.source=NAME")),
        (("method=pmc",), ("did you mean method=pcm?",)),
        (("domain@data.target=objcts",), ("did you mean domain@data.target=objects?",)),
        (("domain@data.source=specklenet",), ("did you mean domain@data.source=specklenet10?",)),
        (("method.again_wieght=1", "method=twin"), ("did you mean method.again_weight=?",)),
        (
            ("experiment=own_scans", "data.target.up=y"),
            ("did you mean data.target.published.up=?",),
        ),
        (("logger=null",), ("ConfigError: logger=null: logger is chosen", "csv, wandb")),
        (("~method",), ("ConfigError: method is not there", "give method=NAME, one of cpcm, ")),
        (("force=no",), ("ConfigError: force must be true or false, got 'no'",)),
        (("compile=off",), ("ConfigError: compile must be true or false, got 'off'",)),
        (("trainer.deterministic=no",), ("trainer.deterministic must be true or false",)),
        (("trainer.cuda_graphs=no",), ("ConfigError: trainer.cuda_graphs must be true or false",)),
        (
            ("trainer.float32_matmul=medium",),
            ("ConfigError: trainer.float32_matmul must be one of ('highest', 'high')",),
        ),
        (
            ("trainer.float32_matmul=high",),
            ("ConfigError: trainer.float32_matmul=high rounds a GPU's products", "trainer=gpu"),
        ),
        (("trainer.limit_val_batches=0",), ("ConfigError: trainer.limit_val_batches must",)),
        (("trainer.limit_train_batches=0.0",), ("limit_train_batches must leave a batch",)),
        (("+trainer.max_steps=3",), ("trainer.max_steps=3 cannot be had", "set protocol.epochs")),
        (
            ("method=pcfea", "protocol.epochs=1"),
            ("method.plain=0.1 of protocol.epochs=1, rounded",),
        ),
        (("+trainer.log_every_n_steps=9",), ("log_every_n_steps=9 cannot be had", "leave it out")),
        (("experiment_name=2024",), ("ConfigError: experiment_name must be text, got 2024",)),
        (("experiment_name=null",), ("ConfigError: experiment_name must be text, got None",)),
        (("experiment_name=a/b",), ("experiment_name=a/b: it is a folder below paths.log_dir",)),
        (("data.target.name=7",), ("ConfigError: data.target.name must be text, got 7",)),
        (("+path=x",), ("ConfigError", "path")),
        (("selection.best=1",), ("keys of selection are teacher, student",)),
        (("data.scale=metres",), ("ConfigError", "domain specklenet10 are not in metres")),
        (
            (
                "data.scale=metres",
                "data.source.unit=metres",
                "data.target.unit=metres",
                "model=simpleview",
            ),
            ("ConfigError", "data.scale=metres and model=simpleview: its cameras"),
        ),
    ],
)
def test_what_is_missing_or_wrong_is_said_before_anything_heavy_is_imported(tmp_path, words, told):
    imported, result = imports_of(tmp_path, "experiment=qs3_s2d", *words)
    assert not imported & HEAVY
    assert result.returncode == 1
    assert all(word in result.stderr for word in told)
    assert "Traceback" not in result.stderr


def test_a_start_that_fails_leaves_no_folder_and_touches_no_other(tmp_path):
    words = "experiment=qs3_s2d", "method=supervised"
    assert command(tmp_path, *words).returncode == 1
    logs = tmp_path / "logs"
    assert list(logs.iterdir()) == []
    (folder,) = _failed(tmp_path, *words)
    (folder / "notes.txt").write_text("mine")
    assert command(tmp_path, *words).returncode == 1
    assert {path.name for path in folder.iterdir()} >= {"notes.txt", "train.log", ".hydra"}
    (folder / "notes.txt").unlink()
    with owned(folder):  # another process that has only just begun
        assert command(tmp_path, *words).returncode == 1
    assert (folder / "train.log").is_file()
    assert command(tmp_path, *words).returncode == 1
    assert not folder.parent.exists()


def _failed(tmp_path, *words):
    """The folder of a job of a sweep, which stays: the summary names it."""
    assert command(tmp_path, *words, "-m").returncode == 1
    return [path.parent for path in (tmp_path / "logs").glob("*/*/train.log")]


def test_missing_data_in_a_multirun_are_said_once(tmp_path):
    result = command(tmp_path, "experiment=qs3_s2d", "seed=0,1", "-m")
    assert result.returncode == 1
    assert (result.stdout + result.stderr).count("failed: MissingDataError") == 1
    assert "majority" not in result.stdout


def test_ddp_is_refused_in_a_multirun(tmp_path):
    result = command(tmp_path, "experiment=qs3_s2d", "trainer=ddp", "seed=0,1", "-m")
    assert result.returncode == 1
    assert "hydra/launcher=joblib" in result.stderr


def test_multirun_then_one_seed(tmp_path, toy_data):  # noqa: F811
    arguments = overrides(tmp_path, f"paths.data_dir={toy_data}", "selftraining=none")
    sweep = command(tmp_path, *arguments, "report.pictures=auto", "seed=0,1", "-m")
    assert sweep.returncode == 0, sweep.stderr
    assert re.search(r"quickstart .* ± .* 2", sweep.stdout)
    assert "simulated" in sweep.stdout
    zero, one = sorted((tmp_path / "logs" / "quickstart").iterdir())
    assert (zero / ".hydra" / "config.yaml").is_file()
    assert not (zero / "wandb").exists()
    page = zero / "pictures" / "index.html"  # of the first run alone
    assert f"\npictures: {page}; of another run: qs3 report page run=PATH" in sweep.stdout
    assert page.is_file()
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
