"""A net of one's own, trained: commands take it if its module is named, and only then."""

import csv

import numpy as np
import pytest
import torch

import qs3
from qs3.config.hashing import run_folder
from qs3.store.store import open_pointset
from qs3.training.command import train
from tests.running import main
from tests.training.toy import toy_config, write_toy

MODULE = "tests.training.toy"
PACKAGES = ("qs3.models", MODULE)


@pytest.fixture(scope="module")
def own_run(tmp_path_factory):
    root = tmp_path_factory.mktemp("own")
    write_toy(root / "data")
    np.save(root / "scans.npy", open_pointset(root / "data" / "kinectsim10").split("test").points)
    config = toy_config(root, "method=source_only", "selftraining=none")
    train(config)
    return run_folder(config), root


def said_of(table):
    with open(table, newline="") as file:
        return np.array(
            [
                [float(row[f"p_{c}"]) for c in ("ball", "rod", "slab")]
                for row in csv.DictReader(file)
            ]
        )


@pytest.fixture
def predict(own_run, tmp_path):
    def run(ckpt, *more):
        words = [f"ckpt={ckpt}", str(own_run[1] / "scans.npy"), f"out={tmp_path / 'said.csv'}"]
        return main(["predict", *words, "page=false", *more])

    return run


def test_it_predicts_what_the_predictor_does(own_run, predict, tmp_path, capsys):
    run, root = own_run
    assert predict(run) == 1
    assert "packages=my_package in a command" in capsys.readouterr().err
    assert not (tmp_path / "said.csv").exists()
    assert predict(run, f"packages={MODULE}") == 0
    clouds = list(np.load(root / "scans.npy"))
    expected = qs3.load(run, packages=PACKAGES)(clouds)
    np.testing.assert_allclose(said_of(tmp_path / "said.csv"), expected, atol=1e-6)


def test_its_folder_is_read_as_its_card_says(own_run, predict, tmp_path, capsys):
    run, root = own_run
    words = ["export", f"ckpt={run}", f"out={tmp_path / 'model'}"]
    assert main(words) == 1
    assert not (tmp_path / "model").exists()  # refused before anything is written
    assert main([*words, f"packages={MODULE}"]) == 0
    assert f"both need packages= and {MODULE}" in capsys.readouterr().out
    card = (tmp_path / "model" / "README.md").read_text()
    (line,) = [line for line in card.splitlines() if line.startswith("predictor = ")]
    predictor = eval(line.partition("= ")[2].replace("this folder", str(tmp_path / "model")))
    clouds = list(np.load(root / "scans.npy"))
    np.testing.assert_array_equal(predictor(clouds), qs3.load(run, packages=PACKAGES)(clouds))
    assert f"`qs3 predict ckpt=FOLDER input=SCANS packages={MODULE}`" in card
    assert predict(tmp_path / "model", f"packages={MODULE}") == 0


def test_it_is_exported_for_use_without_qs3(own_run, tmp_path):
    run, root = own_run
    out = tmp_path / "net.pt2"
    assert main(["export", f"ckpt={run}", f"out={out}"]) == 1
    assert not out.exists()
    assert main(["export", f"ckpt={run}", f"out={out}", f"packages={MODULE}"]) == 0
    predictor = qs3.load(run, packages=PACKAGES)
    points = torch.from_numpy(np.load(root / "scans.npy")[:4, :32])
    logits = torch.export.load(out).module()(points)
    with torch.no_grad():
        assert torch.allclose(logits, predictor.net(points), atol=1e-5)
