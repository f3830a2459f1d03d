"""What to type after an error of Hydra or OmegaConf."""

from __future__ import annotations

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from qs3.utils.hints import hint_of, missing_of


def test_a_hint_survives_values_that_cannot_be_resolved():
    """Beside the key that is meant, one level down, stands what needs more than there is."""
    node = OmegaConf.create({"a": "${nowhere.b}", "c": "${oc.env:QS3_NOT_SET}", "d": {"up": "z"}})
    cause = ConfigKeyError("Key 'up' is not in struct")
    cause.key, cause.full_key, cause.parent_node = "up", "data.target.up", node
    error = RuntimeError()
    error.__cause__ = cause
    assert hint_of(error, ["data.target.up=y"]) == "did you mean data.target.d.up=?"


@pytest.mark.parametrize("value", ["scans (1)", "it's", "a=b", 'a"b', "[a", "C:\\x (1)"])
def test_a_value_that_hydra_cannot_read_is_quoted_for_shell_and_hydra(value):
    with pytest.raises(OverrideParseException) as found:
        OverridesParser.create().parse_overrides([f"folder={value}"])
    typed = hint_of(found.value, []).partition("twice: ")[2]
    (word,) = shlex.split(typed)
    assert OverridesParser.create().parse_override(word).value() == value


@pytest.mark.parametrize("value", ["${seed}", "${paths.log_dir}/${seed}"])
def test_what_an_interpolation_misses_is_told_with_the_word_that_deleted_it(value):
    node = OmegaConf.create({"hydra": {"run": {"dir": value}}, "paths": {}})
    OmegaConf.set_struct(node, True)
    with pytest.raises(OmegaConfBaseException) as found:
        OmegaConf.to_container(node, resolve=True)
    said = missing_of(found.value, ["a=b", "~seed", "~paths"])
    first, second = said.splitlines()
    assert first.startswith("ConfigError: hydra.run.dir: ")
    assert "raised while" not in first
    assert second == "leave out ~seed or ~paths, which deletes it"
    assert missing_of(found.value, ["a=b"]) == first
    assert missing_of(KeyError("seed"), ["~seed"]) == ""
