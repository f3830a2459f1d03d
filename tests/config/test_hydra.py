"""Errors while building from the config, and what loggers are told of a run."""

from __future__ import annotations

from typing import Annotated

import pytest
from annotated_types import Ge
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from qs3.config.hydra import build, config_hash
from qs3.errors import ConfigError
from qs3.utils.settings import settings
from tests.composing import compose
from tests.training.toy import toy_config


@settings
class Ranged:
    points: Annotated[int, Ge(1)]


def refuses(value: int) -> int:
    raise ValueError(f"{value} is too small")


def fails() -> None:
    raise RuntimeError("a defect")


def node(**settings):
    return OmegaConf.create({"a": {"b": settings}}).a.b


def test_what_a_target_does_not_take_is_an_error_of_the_config():
    with pytest.raises(ConfigError, match=r"^a\.b: 3 is too small$"):
        build(node(_target_="tests.config.test_hydra.refuses", value=3))
    with pytest.raises(ConfigError, match=r"^a\.b: .*unexpected keyword argument 'k'"):
        build(node(_target_="tests.config.test_hydra.refuses", k=3))
    inner = {"_target_": "tests.config.test_hydra.refuses", "value": 3}
    with pytest.raises(ConfigError, match=r"^a\.b\.value: 3 is too small$"):
        build(node(_target_="tests.config.test_hydra.refuses", value=inner))


def test_our_own_errors_are_raised_as_they_were():
    with pytest.raises(ConfigError, match="mu"):
        build(node(_target_="qs3.selftraining.selectors.Qbst", mu="two"))


def test_a_range_that_pydantic_refuses_names_its_place():
    with pytest.raises(ConfigError, match=r"^a\.b\.points: "):
        build(node(_target_="tests.config.test_hydra.Ranged", points=0))
    assert build(node(_target_="tests.config.test_hydra.Ranged", points=2)) == Ranged(2)


def test_a_value_from_outside_is_hashed_as_it_is(tmp_path, monkeypatch):
    """And not as the text that asks for it."""
    hashes = []
    for rule in ("last", "source_val"):
        monkeypatch.setenv("RULE", rule)
        hashes.append(config_hash(toy_config(tmp_path, "selection.teacher=${oc.env:RULE}")))
        assert hashes[-1] == config_hash(toy_config(tmp_path, f"selection.teacher={rule}"))
    assert hashes[0] != hashes[1]


def hash_of(*words, **values):
    cfg = compose("train", ["experiment=quickstart", *words])
    for key, value in values.items():
        OmegaConf.update(cfg, key, value, force_add=True)
    return config_hash(cfg)


@pytest.mark.parametrize("none", ["selftraining=none", "selftraining.rounds=0"])
@pytest.mark.parametrize(
    "values",
    [
        {"protocol.batch_size": "${selftraining.batch_size}"},
        {"protocol.batch_size": "${..selftraining.batch_size}"},
        {"data.points": "${oc.select:selftraining.batch_size}"},
        {"short": "${selftraining[batch_size]}", "protocol.batch_size": "${short}"},
        {"data.target.published.more": ["a", "x${selftraining.batch_size}"]},
    ],
)
def test_what_comes_from_settings_of_no_rounds_is_hashed_by_its_value(none, values):
    """They are not hashed themselves: nobody else reads them."""
    small, large = ((none, f"selftraining.batch_size={size}") for size in (16, 64))
    assert hash_of(*small) == hash_of(*large)
    assert hash_of(*small, **values) != hash_of(*large, **values)


def test_all_else_is_hashed_as_it_is_written():
    """As runs were before: what comes from rounds that there are, or from a key of that name."""
    written = {"protocol.batch_size": "${selftraining.batch_size}"}
    assert hash_of(**written) != hash_of("protocol.batch_size=16", "selftraining.batch_size=16")
    other = {"data.selftraining": 16, "protocol.batch_size": "${data.selftraining}"}
    by_value = {**other, "protocol.batch_size": 16}
    assert hash_of("selftraining=none", **other) != hash_of("selftraining=none", **by_value)


def test_other_errors_keep_their_traceback():
    with pytest.raises(InstantiationException, match="a defect"):
        build(node(_target_="tests.config.test_hydra.fails"))


def test_tags(tmp_path):
    """By class, where no command line has named the choices."""
    cfg = toy_config(tmp_path, "logger=wandb")
    OmegaConf.resolve(cfg)  # as `--cfg job --resolve` does: a plain list would be refused there
    expected = ["specklenet10 -> kinectsim10", "pcm", "qbst", "tinynet", "simulated"]
    assert OmegaConf.to_container(cfg.logger.wandb)["tags"] == expected
    cfg = toy_config(tmp_path, "logger=wandb", "selftraining=none", "domain@data.target=scannet10")
    assert cfg.logger.wandb.tags == ["specklenet10 -> scannet10", "pcm", "tinynet"]


def test_what_follows_from_a_dataset_and_a_floor(tmp_path):
    resolved = {
        f"${{qs3.count:{classes}}}": count
        for classes, count in (("null", 10), ("[box,cup]", 2), ("modelnet40", 40))
    }
    resolved |= {"${qs3.scale:null}": "metres", "${qs3.scale:0}": "above_floor"}
    resolved |= {"${qs3.scale:-1.2}": "seen", f"${{qs3.classes:{tmp_path}}}": None}
    for text, expected in resolved.items():
        assert OmegaConf.create({"found": text}).found == expected
    (tmp_path / "meta.yaml").write_text("classes: [box, cup]")
    assert OmegaConf.create({"found": f"${{qs3.classes:{tmp_path}}}"}).found == ["box", "cup"]
