"""The commands of `qs3 quickstart`; it is run as a whole for the table in README.md."""

from __future__ import annotations

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from qs3.commands.quickstart import DATASETS, steps


@pytest.mark.parametrize("out", ["out/quickstart", "my data", "it's", "a,b", "Räume", "[1]"])
def test_any_folder_is_handed_to_every_step(out):
    parser = OverridesParser.create()
    made = steps(out)
    for command in made[: len(DATASETS)]:
        _, script, *words = shlex.split(command)
        assert script == "generate.py"
        given = {one.key_or_group: one.value() for one in parser.parse_overrides(words)}
        for key, name in (("paths.data_dir", "data"), ("paths.log_dir", "logs")):
            assert str(getattr(given[key], "text", given[key])) == f"{out}/{name}"
    for command in made[len(DATASETS) :]:
        assert f"data_dir={out}/data" in shlex.split(command)
