"""Every training command in docs/how-to/sweep.md is one that Hydra understands."""

from __future__ import annotations

import re
import shlex

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from qs3.config.hydra import build
from tests.running import ROOT
from tests.training.toy import CONF

ANY = "+hydra.launcher.additional_parameters.mail-type=END"
PAGE = (ROOT / "docs" / "how-to" / "sweep.md").read_text("utf-8")
COMMANDS = [
    re.split(r"   +|; ", line.strip())[0]
    for line in re.sub(r"\\\n\s*", "", PAGE).splitlines()  # commands of several lines
    if line.startswith("    python train.py")
]


def first_of(word: str) -> str:
    """The word itself, or with the first value of its sweep."""
    override = OverridesParser.create().parse_override(word)
    if not override.is_sweep_override():
        return word
    if override.is_discrete_sweep():
        return f"{override.get_key_element()}={next(override.sweep_string_iterator())}"
    return f"{override.get_key_element()}={override.value().start}"


@pytest.mark.parametrize("command", COMMANDS)
def test_command_composes(command):
    words = [word for word in shlex.split(command)[2:] if not word.startswith("-")]
    words = [first_of(word) for word in words if word != "job"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", words, return_hydra_config=True)
    assert cfg.hydra.launcher._target_
    build(cfg.selftraining)


def test_slurm_takes_every_setting(tmp_path):
    """From conf/hydra/launcher/slurm.yaml to the script that sbatch would get."""
    assert f"`{ANY}`" in PAGE
    from submitit.slurm.slurm import SlurmExecutor, _make_sbatch_string

    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = [
            "hydra/launcher=slurm",
            "hydra.launcher.partition=gpu",
            "hydra.launcher.account=us",
            ANY,
        ]
        launcher = compose("train", words, return_hydra_config=True).hydra.launcher
    given = {k: v for k, v in launcher.items() if v is not None and not k.startswith("_")}
    renamed = {"name": "job_name", "mem_gb": "mem", "timeout_min": "time"}
    ours = {renamed.get(k, k): v for k, v in given.items()}
    ours["mem"] = f"{ours['mem']}GB"
    for key in ("submitit_folder", "max_num_timeout"):
        ours.pop(key)
    ours["additional_parameters"] = dict(ours["additional_parameters"])
    ours["ntasks_per_node"] = ours.pop("tasks_per_node")
    assert set(ours) - {"signal_delay_s"} <= SlurmExecutor._valid_parameters()
    script = _make_sbatch_string("python x", str(tmp_path), map_count=40, **ours)
    for line in (
        "--account=us", "--partition=gpu", "--gpus-per-node=1", "--cpus-per-task=4", "--mem=16GB",
        "--time=720", "--array=0-39%16", "--job-name=qs3", "--mail-type=END",
    ):  # fmt: skip
        assert f"#SBATCH {line}\n" in script, script
