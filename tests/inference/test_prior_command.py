"""prior= where classifiers are used: `qs3.load` and `qs3 predict`."""

from __future__ import annotations

import inspect
import json

import numpy as np
import pytest

import qs3
from qs3.errors import ConfigError
from qs3.evaluation.prior import POWER
from qs3.inference.cli import PREDICT
from tests.composing import compose
from tests.running import main


def test_the_three_ways_to_it_have_one_power() -> None:
    (option,) = (option for option in PREDICT.options if option.key == "prior_power")
    given = inspect.signature(qs3.load).parameters["prior_power"].default
    cfg = compose("train", [])
    assert option.default == given == cfg.evaluation.prior_power == POWER


def test_in_python_and_on_the_command_line(run, tmp_path, capsys) -> None:
    """The same probabilities; what can be expected is told of the answers without it."""
    clouds = np.random.default_rng(0).normal(size=(32, 64, 3))
    np.save(tmp_path / "clouds.npy", clouds)
    plain = qs3.load(run)
    kind = plain.classes[-1]
    weighed = qs3.load(run, prior={kind: 9}, prior_power=1)
    expected = weighed.prior(plain(clouds))
    np.testing.assert_allclose(weighed(clouds), expected)
    before, after = plain(clouds)[:, -1], expected[:, -1]
    assert (after > before).all()
    found = {}
    for name, words in {"plain": [], "prior": [f"prior={kind}:9", "prior_power=1"]}.items():
        out = tmp_path / f"{name}.json"
        ask = ["predict", f"ckpt={run}", f"input={tmp_path / 'clouds.npy'}", f"out={out}"]
        assert main([*ask, *words]) == 0
        text, page = capsys.readouterr().out, out.with_suffix(".html").read_text()
        found[name] = json.loads(out.read_text())
        for shown in (text, page):
            assert ("lasses count as this common, at power 1" in shown) == (name == "prior")
            assert ("told of the answers without prior=" in shown) == (name == "prior")
    assert found["plain"]["prior"] is None
    assert found["prior"]["prior"]["power"] == 1
    assert found["prior"]["prior"]["shares"][kind] == pytest.approx(9 / (8 + len(plain.classes)))
    assert found["prior"]["trust"] == found["plain"]["trust"]
    said = [list(one["probabilities"].values()) for one in found["prior"]["clouds"]]
    np.testing.assert_allclose(said, expected, rtol=1e-5)
    with pytest.raises(ConfigError, match="prior=unicorn"):
        qs3.load(run, prior="unicorn:1")
    assert main([*ask, "prior_power=0.7"]) == 1
    assert "prior_power= is for prior=" in capsys.readouterr().err
