"""That tests which share what Hydra reads get what it would compose for them."""

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from qs3.datasets import domain
from tests.composing import by_hydra, compose, compose_domain
from tests.generation.generating import QUICK
from tests.training.toy import overrides

CASES = {
    "a toy run": ("train", overrides),
    "another scheme": (
        "train",
        lambda root: overrides(root, "selftraining=cbst", "seed=3", "selftraining.init=continue"),
    ),
    "an experiment's own value": (
        "train",
        lambda root: ["experiment=qs3_s2d", f"paths.data_dir={root}", "protocol.epochs=1"],
    ),
    "a key that is added": (
        "train",
        lambda root: ["+model.own=x", f"model.own={root}", "~model.dropout"],
    ),
    "a list, a dict, quotes": (
        "generate",
        lambda root: [
            "domain=specklenet10", *QUICK, f"meshes='{root}/a b'",
            "catalogue.train={chair:1}", f"paths={{data_dir:{root}}}",
        ],
    ),
    "the last word counts": (
        "train",
        lambda root: [f"paths.log_dir={root}", "seed=1", "paths.log_dir=null", "seed=2"],
    ),
    "no command": (
        None,
        lambda root: ["+domain@data.source=own", "+paths=default", f"paths.data_dir={root}"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_it_is_what_hydra_composes(case, tmp_path):
    command, words_of = CASES[case]
    before = compose(command, words_of(tmp_path / "first"))
    same, whole = (how(command, words_of(tmp_path / "second")) for how in (compose, by_hydra))
    assert OmegaConf.to_container(same) == OmegaConf.to_container(whole)
    assert list(same) == list(whole)
    assert OmegaConf.is_struct(same) == OmegaConf.is_struct(whole)
    assert before != same or case == "the last word counts"


def test_what_is_changed_is_nobody_else_s():
    changed = compose("train", ["seed=1"])
    changed.seed = 5
    del changed.protocol
    again = compose("train", ["seed=1"])
    assert (again.seed, "protocol" in again) == (1, True)


@pytest.mark.parametrize("word", ["protocol.no_such=1", "seed=1,2", "a.=", "model=no"])
def test_what_hydra_refuses_is_refused(word):
    with pytest.raises(HydraException) as said:
        by_hydra("train", [word])
    with pytest.raises(HydraException) as ours:
        compose("train", [word])
    assert str(ours.value) == str(said.value)


def test_a_domain_is_what_the_package_composes(tmp_path):
    keys = {"paths.data_dir": str(tmp_path), "path": str(tmp_path / "x"), "published.tiers": "[a]"}
    ours, theirs = (made("nyuv2", keys) for made in (compose_domain, domain.compose_domain))
    assert ours == theirs
    assert ours.folder == tmp_path / "x"
