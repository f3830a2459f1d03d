"""That tests which share what Hydra reads get what it would compose for them."""

import pytest
from omegaconf import OmegaConf

from tests.composing import by_hydra, compose
from tests.generation.generating import QUICK
from tests.training.toy import overrides

CASES = {
    "a toy run": ("train", overrides),
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
