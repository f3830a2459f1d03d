"""The command itself, as a user types it: messages, multirun, what it imports."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import build
from tests.training.conftest import result_of, toy_data  # noqa: F401 (a fixture)
from tests.training.toy import CONF, overrides

ROOT = Path(__file__).parents[2]
EXPERIMENTS = sorted(
    path.stem
    for path in (CONF / "experiment").glob("*.yaml")
    if "train.py" in path.read_text().splitlines()[1]
)


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


HEAVY = {"torch", "lightning", "scipy", "cv2", "matplotlib", "wandb", "bpy", "mitsuba"}
"""What takes a second and more to import, or a part of one."""


def imports_of(folder: Path, *arguments: str) -> tuple[set[str], subprocess.CompletedProcess]:
    """Names of all packages that the command imports; stderr is without the list."""
    listed = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONPROFILEIMPORTTIME": "1"}
    result = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *arguments], cwd=folder, env=listed,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
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


@pytest.mark.parametrize(
    "override",
    ["domain@data.source=modelnet10", "domain@data.target=scannet10", "model=dgcnn"]
    + [f"method={name}" for name in ("source_only", "supervised", "pcm")]
    + [f"selftraining={name}" for name in ("none", "qbst")]
    + [f"trainer={name}" for name in ("cpu", "gpu", "ddp")]
    + [f"logger={name}" for name in ("csv", "wandb")]
    + ["protocol=paper", "debug=fast", "seed=7", "force=true"],
)
def test_names_on_the_command_line(override):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        compose("train", ["experiment=qs3_s2d", override])


def test_help_imports_nothing_heavy(tmp_path):
    """So it is there at once; tests/benchmarks/test_command_speed.py has the time."""
    imported, result = imports_of(tmp_path, "--help")
    assert result.returncode == 0
    assert not imported & HEAVY
    lines = result.stdout.splitlines()
    assert len(lines) < 40
    assert max(map(len, lines)) <= 100
    for group in ("domain", "experiment", "logger", "method", "model", "selftraining", "trainer"):
        for path in (CONF / group).glob("*.yaml"):
            assert re.search(rf"\b{path.stem}\b", result.stdout), path


def test_missing_data_is_said_before_anything_heavy_is_imported(tmp_path):
    imported, result = imports_of(tmp_path, "experiment=qs3_s2d")
    assert not imported & HEAVY
    assert result.returncode == 1
    assert "specklenet10" in result.stderr
    assert "meta.yaml" in result.stderr
    assert "generate.py" in result.stderr
    assert "Traceback" not in result.stderr


def test_missing_data_in_a_multirun_are_said_once(tmp_path):
    result = command(tmp_path, "experiment=qs3_s2d", "seed=0,1", "-m")
    assert result.returncode == 1
    assert (result.stdout + result.stderr).count("failed: MissingDataError") == 1
    assert "majority" not in result.stdout


def test_upper_bound_with_rounds_is_refused_before_torch_is_imported():
    code = (
        "import sys; from pathlib import Path; import qs3.config.hydra, qs3.training.command\n"
        "from hydra import compose, initialize_config_dir\n"
        "with initialize_config_dir(sys.argv[1], version_base='1.3'):\n"
        "    cfg = compose('train', ['experiment=qs3_s2d', 'method=supervised'])\n"
        "try: qs3.training.command.train(cfg)\n"
        "except qs3.training.command.ConfigError as error: print(error, 'torch' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(CONF)], cwd=ROOT, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert result.stdout.strip().endswith("set selftraining=none False")


def test_no_torch_before_the_data_are_there():
    code = "import sys, qs3.training.command, qs3.config.hydra; print('torch' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "False"


def test_misspelt_key(tmp_path):
    result = command(tmp_path, "experiment=qs3_s2d", "selftraining.thetaa=1")
    assert result.returncode == 1
    assert "thetaa" in result.stderr


def test_ddp_is_refused_in_a_multirun(tmp_path):
    result = command(tmp_path, "experiment=qs3_s2d", "trainer=ddp", "seed=0,1", "-m")
    assert result.returncode == 1
    assert "hydra/launcher=joblib" in result.stderr


def test_multirun_then_one_seed(tmp_path, toy_data):  # noqa: F811
    arguments = overrides(tmp_path, f"paths.data_dir={toy_data}", "selftraining=none")
    sweep = command(tmp_path, *arguments, "seed=0,1", "-m")
    assert sweep.returncode == 0, sweep.stderr
    assert re.search(r"quickstart .* ± .* 2", sweep.stdout)
    assert "simulated" in sweep.stdout
    zero, one = sorted((tmp_path / "logs" / "quickstart").iterdir())
    assert (zero / ".hydra" / "config.yaml").is_file()
    assert not (zero / "wandb").exists()

    imported, again = imports_of(tmp_path, *arguments, "seed=1")
    assert not imported & HEAVY
    assert "already finished" in again.stdout
    alone = command(tmp_path, *arguments, "seed=1", f"paths.log_dir={tmp_path / 'alone'}")
    assert alone.returncode == 0, alone.stderr
    (folder,) = (tmp_path / "alone" / "quickstart").iterdir()
    assert folder.name == one.name
    assert result_of(folder) == result_of(one)


def test_csv_logger_does_not_import_wandb(tmp_path, toy_data):  # noqa: F811
    code = (
        "import sys; from pathlib import Path; import qs3.config.hydra; "
        "from qs3.training.command import train; "
        "from tests.training.toy import toy_config; "
        "train(toy_config(Path(sys.argv[1]), sys.argv[2], 'selftraining=none')); "
        "print('wandb' in sys.modules)"
    )
    arguments = [sys.executable, "-c", code, str(tmp_path), f"paths.data_dir={toy_data}"]
    result = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "False"


@pytest.mark.slow
def test_two_processes(tmp_path, toy_data):  # noqa: F811
    """DDP on the CPU: finishes, and an interrupted one goes on (from the last checkpoint)."""
    arguments = overrides(tmp_path, f"paths.data_dir={toy_data}", "trainer.devices=2")
    result = command(tmp_path, *arguments, "trainer.strategy=ddp")
    assert result.returncode == 0, result.stderr
    (folder,) = (tmp_path / "logs" / "quickstart").iterdir()
    expected = result_of(folder)
    (folder / "metrics.json").unlink()
    assert command(tmp_path, *arguments, "trainer.strategy=ddp").returncode == 0
    assert result_of(folder) == expected
