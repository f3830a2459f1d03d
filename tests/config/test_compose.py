"""Composing inside another program, and text that Hydra reads as that text."""

from __future__ import annotations

import shlex

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobRuntime
from hydra.version import VersionBase, getbase, setbase
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from qs3.config.compose import composed, override, quoted
from qs3.errors import ConfigError
from qs3.tools.toy import toy_overrides


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


ODD = "/a b/(c),[d]{e}='f\"g\\h/${i}:é"
FOLDERS = [ODD, "1e3", "null", "a,b", "x=y", "", " a ", "\\", "'", "\\'", "~", "a\\${b}\\", "${"]


def understood(word: str):
    """As Hydra parses it and OmegaConf then resolves it."""
    one = OverridesParser.create().parse_override(word)
    assert not one.is_sweep_override()
    cfg = OmegaConf.create({"folder": None, "data": "${folder}/data"})
    OmegaConf.update(cfg, one.key_or_group, one.value())
    assert cfg.data == f"{cfg.folder}/data"
    return cfg.folder


@settings(max_examples=50)
@given(st.text(st.sampled_from("ab1.,:=~/\\'\"()[]{}$ \té日\n-+e") | st.characters(codec="utf-8")))
@example("${oc.env:HOME}")
@example("\\\\${a}")
@example(ODD)
def test_any_text_is_read_back(text):
    assert understood(override("folder", text)) == text


def test_odd_names_of_folders_survive_a_shell():
    for text in FOLDERS:
        (word,) = shlex.split(shlex.join([override("folder", text)]))
        assert understood(word) == text


def test_plain_words_and_interpolations_stay_as_they_are():
    for text in ("/home/me/logs", "a_b-c.d", "../x", "a+b", "${paths.data_dir}/x"):
        assert quoted(text) == text


@pytest.mark.slow
def test_every_path_of_ours_reaches_the_config(tmp_path):
    """The toy's words, and those of a table's cells."""
    folder = tmp_path / "1, b (c) [d] it's ${x}"
    cfg = composed("train", *toy_overrides(folder))
    paths = [cfg.paths.data_dir, cfg.paths.log_dir, cfg.paths.warmup_dir]
    assert paths == [str(folder / part) for part in ("data", "logs", "warmups")]
    assert cfg.data.target.path == str(folder / "data" / "toy_target")
    assert list(cfg.data.source.classes) == ["ball", "rod", "slab", "plank"]
