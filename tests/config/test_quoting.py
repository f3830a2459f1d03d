"""What we hand to Hydra as text, Hydra reads as that text."""

from __future__ import annotations

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from qs3.config.compose import composed
from qs3.config.quoting import as_text, override, quoted, words_of
from qs3.errors import ConfigError
from qs3.report.cli import _built
from qs3.report.tables.running import Job, launch
from qs3.tools.toy import toy_overrides

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


@pytest.mark.parametrize("text", ["/home/me/logs", "a_b-c.d", "../x", "dgcnn", "a+b"])
def test_plain_words_stay_as_they_are(text):
    assert quoted(text) == text


def test_an_interpolation_stays_one_where_it_was_typed():
    assert quoted("${paths.data_dir}/x") == "${paths.data_dir}/x"


@pytest.mark.parametrize(
    ("typed", "read"),
    [
        ("data.target.published.folder=Meine Räume", "Meine Räume"),
        ("folder=日本/a&b;#1", "日本/a&b;#1"),
        ("data.target.published.folder=~/scans", "/home/me/scans"),
        ("meshes=~", "/home/me"),
        ("meshes=~you/a", "~you/a"),
        ("+domain.published.folder=2024", "2024"),
        ("paths.data_dir=1e3", "1e3"),
    ],
)
def test_a_word_that_can_be_nothing_but_text_is_read_as_it_was_typed(typed, read, monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    word = as_text(typed)
    assert OverridesParser.create().parse_override(word).value() == read
    assert as_text(word) == word  # a process that is started with it does it again


OTHERS = ["seed=0,1", "data.points=128", "lr=1e-3", "a=${b}", "meshes=null", "a=[b", "a=true"]
ODD_OTHERS = ["folder=a (1)", "-m", "--config-dir=ä", "~a", "a='ä'", "a=x y", "a=", "a=range(1,3)"]


@pytest.mark.parametrize("word", [*OTHERS, *ODD_OTHERS])
def test_other_words_stay_as_they_are(word):
    assert as_text(word) == word


def test_folders_with_umlauts_and_numbers_reach_the_config():
    own = ("experiment=own_scans", "data.target.published.folder=Räume")
    cfg = composed("train", *own, "data.target.path=2024")
    assert (cfg.data.target.published.folder, cfg.data.target.path) == ("Räume", "2024")


def test_every_path_of_ours_reaches_the_config(tmp_path):
    """The toy's words, and those of a table's cells."""
    folder = tmp_path / "1, b (c) [d] it's ${x}"
    cfg = composed("train", *toy_overrides(folder))
    paths = [cfg.paths.data_dir, cfg.paths.log_dir, cfg.paths.warmup_dir]
    assert paths == [str(folder / part) for part in ("data", "logs", "warmups")]
    assert cfg.data.target.path == str(folder / "data" / "toy_target")
    assert list(cfg.data.source.classes) == ["ball", "rod", "slab", "plank"]
    options = ("quickstart", str(folder), f"{folder}/data", None, "")
    with pytest.raises(ConfigError, match="is not there; it is the paths"):
        _built(*options)
    assert not folder.exists()
    folder.mkdir()
    table = _built(*options)
    (cell, *_) = [cell for cell in table.cells if cell.runnable]
    paths = composed("train", *cell.overrides).paths
    assert (paths.log_dir, paths.data_dir) == (str(folder), f"{folder}/data")


def test_a_line_of_overrides_with_an_open_quote_is_an_error_for_people(tmp_path):
    assert words_of("overrides", "a='1 2' b=3") == ["a=1 2", "b=3"]
    for line in ("data.target.title=it's", 'a="b', "a=b\\"):
        with pytest.raises(ConfigError, match=r"overrides=.*: no (closing|escaped)"):
            _built("quickstart", str(tmp_path), None, None, line)


@pytest.mark.slow
def test_a_launched_job_finds_its_folder(tmp_path):
    """It ends there, because there are no data."""
    folder = tmp_path / "a, b (c) [d] it's"
    paths = override("paths.log_dir", folder), override("paths.data_dir", folder / "data")
    job = Job("r", ("experiment=quickstart", *paths))
    assert launch([job], "joblib", 1, str(folder)) == 1
    (config,) = folder.glob("quickstart/seed0-*/.hydra/config.yaml")
    assert OmegaConf.load(config).paths.data_dir == str(folder / "data")
