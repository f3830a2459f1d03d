"""B: the same objects and views as S, and another sensor."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from qs3.generation.command import generate
from tests.generation.generating import composed


def config(domain, *overrides):
    return composed(f"domain={domain}", *overrides)


def test_b_is_s_but_for_its_name_and_its_sensor():
    s, b = (
        OmegaConf.to_container(config(name), resolve=True) for name in ("specklenet10", "blensor10")
    )
    for cfg in (s, b):
        del cfg["sensor"], cfg["recipe"]["sensor"]
        for key in ("name", "symbol", "title", "path", "published", "how_to_get", "make"):
            del cfg["domain"][key]
    assert s == b


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """One chair and one table, seen by two sensors with the same camera."""
    found = {}
    for key, domain in (("S", "specklenet10"), ("B", "blensor10")):
        data_dir = tmp_path_factory.mktemp(key)
        quick = ["renderer.samples=2", "views=2", "workers=0", "limit=1"]
        where = ["classes=[chair,table]", "splits=[test]", f"paths.data_dir={data_dir}"]
        found[key] = (generate(config(domain, *quick, *where)), data_dir / domain)
    return found


def test_poses_and_placing_are_those_of_s(made):
    clean = {key: np.load(folder / "points_clean.npy") for key, (_, folder) in made.items()}
    noisy = {key: np.load(folder / "points.npy") for key, (_, folder) in made.items()}
    assert len(clean["S"]) == 2
    assert made["B"][0].ids == made["S"][0].ids
    np.testing.assert_array_equal(clean["B"], clean["S"])
    assert not np.array_equal(noisy["B"], noisy["S"])
