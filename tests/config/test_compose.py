"""Composing inside another program: what of Hydra's is its own stays so."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import JobRuntime
from hydra.version import VersionBase, getbase, setbase

from qs3.config.compose import composed
from qs3.errors import ConfigError

APP = """
import os
import hydra

@hydra.main(version_base="1.1", config_path=None)
def main(cfg):
    print(os.getcwd(), hydra.core.hydra_config.HydraConfig.get().job.name, flush=True)
    from qs3.datasets.domain import compose_domain
    compose_domain("own", {})

main()
"""


def test_an_application_of_another_version_goes_on_as_it_began(tmp_path):
    """By Hydra 1.1 each job has a working folder of its own; so has the second one."""
    (tmp_path / "outer.py").write_text(APP)
    command = [sys.executable, "-W", "ignore", "outer.py", "-m", "+job=0,1", "hydra.sweep.dir=out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines() if str(tmp_path) in line]
    assert [(Path(folder).name, name) for folder, name in lines] == [("0", "outer"), ("1", "outer")]


@pytest.mark.parametrize("word", ["seed=1", "no_such=1"])
@pytest.mark.parametrize("version", ["1.2", None])
def test_what_is_global_is_as_it_was(word, version, monkeypatch):
    monkeypatch.setattr(VersionBase.instance(), "version_base", None)  # to be put back
    setbase(version)
    JobRuntime.instance().set("name", "outer")
    kinds = GlobalHydra, VersionBase, JobRuntime
    before = [kind.instance() for kind in kinds], getbase()
    try:
        composed("train", word)
    except ConfigError:
        assert word == "no_such=1"
    after = [kind.instance() for kind in kinds], getbase()
    assert all(one is other for one, other in zip(after[0], before[0], strict=True))
    assert after[1] == before[1]
    assert JobRuntime.instance().get("name") == "outer"
