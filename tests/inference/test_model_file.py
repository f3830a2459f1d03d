"""A classifier on disk gives itself back to the last bit, and nothing damaged or made up."""

from __future__ import annotations

import os
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

import qs3
from qs3.classes import CLASSES
from qs3.datasets.published import named_arrays
from qs3.errors import DataError, MissingDataError
from qs3.inference.export import export_folder
from qs3.inference.model_file import (
    CONFIG,
    PRETRAINED,
    WEIGHTS,
    find_result,
    pretrained_names,
    read_result,
    write_result,
)
from qs3.inference.predictor import load
from qs3.runs.metrics import read_metrics
from tests.running import main
from tests.training.toy import TinyNet


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "model"
    export_folder(run, folder)
    return folder


@pytest.fixture
def folder(exported, tmp_path) -> Path:
    return shutil.copytree(exported, tmp_path / "model")


def changed(run: Path, folder: Path, **values: Any) -> Path:
    found = torch.load(run / "result.pt", weights_only=True)
    torch.save({**found, **values}, folder / "result.pt")
    return folder / "result.pt"


def test_written_is_read(tmp_path, run):
    result = replace(
        read_result(run),
        points=17,
        gravity="none",
        classes=("é", "a b", "\n"),
        usual={"height": [0.1 + 0.2, float("inf")]},
        learnt=(0.2, 1 / 3, 1e-300),
    )
    write_result(tmp_path / "result.pt", result)
    export_folder(tmp_path / "result.pt", tmp_path / "model")
    for place in (tmp_path / "result.pt", tmp_path / "model"):
        again = read_result(place)
        for field in ("points", "gravity", "classes", "usual", "model", "learnt"):
            assert getattr(again, field) == getattr(result, field)
        assert all(torch.equal(again.weights[k], v) for k, v in result.weights.items())


def test_a_folder_is_the_classifier_and_its_half_nearly(run, folder, tmp_path):
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", CONFIG, WEIGHTS]
    clouds = np.random.default_rng(0).normal(size=(4, 64, 3))
    np.testing.assert_array_equal(qs3.load(folder)(clouds), qs3.load(run)(clouds))
    export_folder(folder, tmp_path / "half", half=True)
    np.testing.assert_allclose(
        qs3.load(tmp_path / "half")(clouds), qs3.load(run)(clouds), atol=0.01
    )
    sizes = [(path / WEIGHTS).stat().st_size for path in (folder, tmp_path / "half")]
    assert sizes[1] < 0.6 * sizes[0]
    kept = (folder / "README.md").read_text()
    assert (tmp_path / "half" / "README.md").read_text() == kept


def test_other_weights_and_cut_ones_are_refused(folder):
    data = (folder / WEIGHTS).read_bytes()
    flipped = bytearray(data)
    flipped[-5] ^= 1
    for damaged in (b"", data[: len(data) // 2], bytes(flipped), data + b"\0"):
        (folder / WEIGHTS).write_bytes(damaged)
        with pytest.raises(DataError, match=WEIGHTS):
            qs3.load(folder)


@pytest.mark.parametrize("text", ["", "[1]", "{", "{}", '{"weights_sha256": 1}'])
def test_a_damaged_config_is_named(folder, text):
    (folder / CONFIG).write_text(text)
    with pytest.raises(DataError, match=CONFIG):
        qs3.load(folder)
    (folder / CONFIG).unlink()
    with pytest.raises(MissingDataError, match=CONFIG):
        qs3.load(folder)


class _Evil:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def test_pickles_are_refused_unopened(run, tmp_path):
    mark = tmp_path / "was_run"
    (tmp_path / "a.pt").write_bytes(pickle.dumps(_Evil(mark)))
    shutil.move(changed(run, tmp_path, classes=_Evil(mark)), tmp_path / "b.pt")
    for file in ("a.pt", "b.pt"):
        with pytest.raises(DataError):
            qs3.load(tmp_path / file)
    assert not mark.exists()


@pytest.mark.parametrize(
    "model",
    [
        {"_target_": "os.mkdir", "path": "{mark}"},
        {"_target_": "qs3.models.os.mkdir", "path": "{mark}"},
        {"_target_": "qs3.models.base.nn.Linear", "in_features": 1, "out_features": 1},
        {"_target_": "qs3.models.base.DataError"},  # defined elsewhere
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": {"_target_": "os.getcwd"}},
        {"_target_": "qs3.models.dgcnn.nothing", "num_classes": 3},
        {"_target_": "qs3.models.nothing.dgcnn", "num_classes": 3},
        {"_target_": "qs3.kernels.norms.head_norm", "kind": "batch"},  # ours, but gives no net
        {"_target_": "tests.training.toy.TinyNet", "num_classes": 3},
        {"_target_": 7},
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": -1},
        {},
    ],
    ids=str,
)
def test_only_our_nets_are_built(run, tmp_path, model):
    mark = tmp_path / "was_run"
    model = {k: v.format(mark=mark) if isinstance(v, str) else v for k, v in model.items()}
    with pytest.raises(DataError):
        qs3.load(changed(run, tmp_path, model=model))
    assert not mark.exists()


@pytest.mark.parametrize("package", ["tests.training", "tests.training.toy"])
def test_a_net_of_ones_own_is_asked_for_by_package_or_module(run, tmp_path, package, capsys):
    torch.manual_seed(0)
    net = TinyNet(3).eval()
    model = {"_target_": "tests.training.toy.TinyNet", "num_classes": 3}
    file = changed(run, tmp_path, model=model, weights=net.state_dict())
    found = load(file, packages=("qs3.models", package))
    assert isinstance(found.net, TinyNet)
    assert not found.net.training
    assert main(["export", str(file), f"out={tmp_path / 'own'}"]) == 1
    assert not (tmp_path / "own").exists()  # refused before anything is written
    assert main(["export", str(file), f"out={tmp_path / 'own'}", f"packages={package}"]) == 0
    again = load(tmp_path / "own", packages=package)  # a word is one package
    for name, value in net.state_dict().items():
        assert torch.equal(again.net.state_dict()[name], value)
    assert (
        'packages=["qs3.models", "tests.training.toy"]' in (tmp_path / "own/README.md").read_text()
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("classes", ["only"]), ("points", 0), ("stored_points", "many"), ("gravity", "down"),
        ("scale", "feet"), ("target", None), ("usual", [1]), ("weights", {"a": 1}),
        ("colour", "red"),
    ],
)  # fmt: skip
def test_damaged_values_are_named(run, tmp_path, key, value):
    with pytest.raises(DataError, match=key):
        qs3.load(changed(run, tmp_path, **{key: value}))


def test_weights_of_another_net_and_truncated_files_are_refused(run, tmp_path):
    with pytest.raises(DataError, match="dgcnn"):
        qs3.load(changed(run, tmp_path, weights={"a": torch.zeros(1)}))
    data = (run / "result.pt").read_bytes()
    for size in (0, 10, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.pt").write_bytes(data[:size])
        with pytest.raises(DataError, match=r"cut\.pt"):
            qs3.load(tmp_path / "cut.pt")


def test_what_is_not_a_run_is_missing(run, tmp_path):
    for place in (tmp_path / "nothing", run.parent, tmp_path, "dgcnn-speckel"):
        with pytest.raises(MissingDataError):
            qs3.load(place)


def test_the_card_holds_what_the_run_knows(run, folder, tmp_path):
    text, metrics = (folder / "README.md").read_text(), read_metrics(run)
    _, front, body = text.split("---\n", 2)
    assert yaml.safe_load(front)["library_name"] == "qs3"
    final = metrics.final
    assert f"On {final.n} test clouds of kinectsim10 (simulated): {final.accuracy:.1%}" in body
    interval = re.search(r"95 % interval ([\d.]+)% to ([\d.]+)%", body)
    assert float(interval[1]) < 100 * final.accuracy < float(interval[2])
    for words in (metrics.config_sha256, metrics.data.source, "ball, rod, slab", "(simulated)"):
        assert words in body
    alone = tmp_path / "sent.pt"
    alone.write_bytes((run / "result.pt").read_bytes())
    export_folder(alone, tmp_path / "other")
    other = (tmp_path / "other" / "README.md").read_text()
    assert "%" not in other
    assert "Not recorded" in other


def test_the_command_on_the_card_has_no_folders_of_its_machine(run, tmp_path):
    words = ["experiment=x", "paths.data_dir=/home/me", "data.target.path=/home/me/my scans"]
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / "result.pt").write_bytes((run / "result.pt").read_bytes())
    (tmp_path / "run" / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(words))
    export_folder(tmp_path / "run", tmp_path / "model")
    text = (tmp_path / "model" / "README.md").read_text()
    assert "qs3-train experiment=x 'data.target.path=my scans'" in text
    assert "/home" not in text


def test_what_is_there_stays(run, tmp_path):
    (tmp_path / "README.md").write_text("mine")
    assert main(["export", f"ckpt={run}", f"out={tmp_path}"]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert main(["export", f"ckpt={run}", f"out={tmp_path / 'model'}"]) == 0
    assert main(["export", f"ckpt={tmp_path / 'model'}", f"out={tmp_path / 'model'}"]) == 1


def test_what_comes_with_qs3_is_whole_and_knows_scans_of_meshes_it_never_saw():
    size = sum(file.stat().st_size for file in PRETRAINED.rglob("*") if file.is_file())
    assert size < 11e6  # a package is not the place for more
    sample = named_arrays(PRETRAINED / "source_sample.npz")
    truth = sample["cls"]
    assert len(pretrained_names()) == 2
    for name in pretrained_names():
        predictor = qs3.load(name)
        assert predictor.classes == CLASSES
        floor = 0.0 if predictor.needs_floor else None
        found = predictor(sample["points"][::10].astype(np.float32), floor=floor)
        right = np.mean(np.array(CLASSES)[found.argmax(axis=1)] == truth[::10])
        assert right > 0.6, name
        assert "On real objects of `nyuv2_train_objects.npz`" in (
            (PRETRAINED / name / "README.md").read_text()
        )


def test_a_folder_of_the_name_comes_first(exported, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (name, *_) = pretrained_names()
    assert find_result(name) == PRETRAINED / name / WEIGHTS
    shutil.copytree(exported, tmp_path / name)
    assert qs3.load(name).classes == ("ball", "rod", "slab")
