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
