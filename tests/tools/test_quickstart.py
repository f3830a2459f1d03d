"""The commands of `qs3 quickstart`; it is run as a whole for the table in README.md."""

from __future__ import annotations

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from qs3.__main__ import QS3
from qs3.tools.quickstart import DATASETS, steps


@pytest.mark.parametrize("out", ["out/quickstart", "my data", "it's", "a,b", "x=1", "Räume", "[1]"])
def test_any_folder_is_handed_to_every_step(out):
    parser = OverridesParser.create()
    made = steps(out)
    for command in made[: len(DATASETS)]:
        python, script, *words = shlex.split(command)
        assert (python, script) == ("python", "generate.py")
        given = {one.key_or_group: one.value() for one in parser.parse_overrides(words)}
        assert (
            str(getattr(given["paths.data_dir"], "text", given["paths.data_dir"])) == f"{out}/data"
        )
        assert str(getattr(given["paths.log_dir"], "text", given["paths.log_dir"])) == f"{out}/logs"
    report = QS3.command("report")
    for command in made[len(DATASETS) :]:
        qs3, group, name, *words = shlex.split(command)
        assert (qs3, group) == ("qs3", "report")
        word, words = ("table", [name, *words]) if "=" in name else (name, words)
        given = report.command(word).parse(words)
        assert given["data_dir"] == f"{out}/data"
        assert str(given.get("out") or out).startswith(out)


def test_the_default_folder_needs_no_quotes():
    assert "paths.data_dir=out/quickstart/data paths.log_dir=out/quickstart/logs" in " ".join(
        steps("out/quickstart")
    )
