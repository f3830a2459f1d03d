"""A warm-up by code that was edited since is nobody's, and a result is that of the old code."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from qs3.config.hydra import run_folder
from qs3.training import provenance as code
from qs3.training.command import train
from qs3.training.provenance import changed_files, files_sha256

NET = "from tests.training.toy import TinyNet\n\n\nclass Net(TinyNet):\n    pass\n"
ROOT = Path(code.__file__).parents[1]


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A file with a net, and what a new process would do about it."""
    file = tmp_path / "nets" / "my_own_nets.py"
    file.parent.mkdir()
    file.write_text(NET)
    monkeypatch.syspath_prepend(file.parent)
    yield file
    sys.modules.pop("my_own_nets", None)
    code._sha256.cache_clear()


def of(target: str) -> dict[str, str]:
    return files_sha256(OmegaConf.create({"model": {"part": [{"_target_": target}]}}))


def test_own_files_count_as_they_were_when_the_process_began(own, monkeypatch):
    monkeypatch.setattr(code, "PACKAGES", ("methods",))  # which is quicker
    code._sha256.cache_clear()
    first = of("my_own_nets.Net")
    assert {*first} == {"qs3's code", str(own.parent)}
    for other in ("torch.optim.Adam", "nobody.has.This", "qs3.methods.pcm.Pcm"):
        assert {*of(other)} == {"qs3's code"}
    own.with_name("beside.py").write_text("x = 1\n")
    assert of("my_own_nets.Net") == first
    code._sha256.cache_clear()
    assert changed_files(first) == {str(own.parent): of("my_own_nets.Net")[str(own.parent)]}
    second = of("my_own_nets.Net")
    own.write_text(NET.replace("pass", "dropout = 0.1"))
    code._sha256.cache_clear()
    assert of("my_own_nets.Net") not in (first, second)


@pytest.mark.slow
def test_a_warm_up_of_a_net_that_was_edited_is_trained_again(own, toy, caplog):
    """It went on from the old net's checkpoint, even where its run had been deleted."""
    caplog.set_level("INFO")
    cfg = toy("model._target_=my_own_nets.Net", "selftraining=none", "protocol.epochs=2")
    for edit, taken in (("", False), ("", True), ("    width = 3\n", False)):
        own.write_text(own.read_text() + edit)
        code._sha256.cache_clear()
        caplog.clear()
        train(cfg)
        assert ("the warm-up was trained before" in caplog.text) == taken
        shutil.rmtree(run_folder(cfg))
