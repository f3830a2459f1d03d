"""A finished run gives its classifier back, the same to the last digit, and nothing else."""

from __future__ import annotations

import inspect
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import qs3
from qs3.datamodules import DomainData
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.inference.model_file import read_result, write_result
from qs3.inference.predictor import load
from qs3.models.dgcnn import dgcnn
from qs3.runs.predictions import read_predictions
from qs3.store.store import open_pointset
from tests.inference.conftest import over_the_floor
from tests.limits import memory_of_at_most, time_of_at_most


@pytest.fixture(scope="module")
def predictor(run):
    return qs3.load(run)


@pytest.fixture(scope="module")
def test_clouds(data_dir) -> np.ndarray:
    return np.array(open_pointset(data_dir / "kinectsim10").split("test").points)


def plain(run: Path) -> dict[str, Any]:
    return torch.load(run / "result.pt", weights_only=True)


def changed(run: Path, folder: Path, **values: Any) -> Path:
    torch.save({**plain(run), **values}, folder / "result.pt")
    return folder / "result.pt"


def test_memory_that_predictions_free_is_kept(run, monkeypatch):
    asked = []
    monkeypatch.setattr("qs3.inference.predictor.keep_freed_memory", lambda: asked.append(1))
    qs3.load(run)
    assert asked == [1]


def test_predictions_of_the_run_to_the_last_digit(run, predictor, test_clouds, tmp_path):
    expected = read_predictions(run / "predictions.csv")
    assert not (run / ".hydra").exists()  # called from Python: nothing but the run's own files
    assert predictor.classes == expected.classes
    assert not any(module.training for module in predictor.net.modules())
    np.testing.assert_array_equal(predictor(test_clouds, batch_size=64), expected.probabilities)
    # sums in batches of another size may be added otherwise
    np.testing.assert_allclose(
        predictor(test_clouds, batch_size=5), expected.probabilities, atol=1e-6
    )
    alone = tmp_path / "sent_by_mail.pt"  # the file alone is enough
    alone.write_bytes((run / "result.pt").read_bytes())
    state = torch.get_rng_state()
    np.testing.assert_array_equal(qs3.load(alone)(test_clouds[:3]), predictor(test_clouds[:3]))
    assert torch.equal(torch.get_rng_state(), state)  # the caller's random numbers stay


def test_a_net_of_metres_sees_what_it_was_tested_on_and_how_large_a_cloud_is(
    metric_run, data_dir, test_clouds
):
    metric = qs3.load(metric_run)
    assert metric.in_metres
    data = DomainData("kinectsim10", points=32, scale="metres", data_dir=data_dir)
    data.setup("test")
    seen = torch.cat([batch["points"] for batch in data.test_dataloader()])
    ready = torch.stack([metric.prepare(cloud).points for cloud in test_clouds])
    assert torch.equal(ready, seen)
    with torch.no_grad():
        assert torch.equal(metric.net(ready), metric.net(seen))
    expected = read_predictions(metric_run / "predictions.csv").probabilities
    np.testing.assert_array_equal(metric(test_clouds, batch_size=64), expected)
    # Moving a cloud changes nothing, and its size does.
    np.testing.assert_allclose(metric(test_clouds[:4] + 8), expected[:4], atol=1e-3)
    assert np.abs(metric(3 * test_clouds[:4]) - expected[:4]).max() > 1e-2
    assert metric.prepare(test_clouds[0]).strange == ()
    assert metric.prepare(1000 * test_clouds[0]).strange[0].startswith("size ")


def test_a_net_of_heights_is_told_where_the_floor_is(metric_run, test_clouds, tmp_path):
    metric = qs3.load(metric_run)
    high = over_the_floor(metric)  # -1.25 in its target
    assert (metric.needs_floor, high.needs_floor, high.in_metres) == (False, True, True)
    centred, seen = (which.prepare(test_clouds[0]).points for which in (metric, high))
    assert torch.equal(centred[:, :2], seen[:, :2])
    lowest = test_clouds[0][:, 2].min()
    assert float(seen[:, 2].min()) == pytest.approx(lowest + 1.25, abs=0.05)
    same, given = high.prepare(test_clouds[0], floor=-1.25), high.prepare(test_clouds[0], floor=2)
    assert torch.equal(same.points, seen)
    assert torch.allclose(given.points[:, 2], seen[:, 2] - 3.25, atol=1e-5)
    moved = high(test_clouds[:3] + np.float32([8, -8, 1]), floor=-0.25)
    np.testing.assert_allclose(moved, high(test_clouds[:3]), atol=1e-3)
    assert np.abs(high(test_clouds[:3], floor=1) - high(test_clouds[:3])).max() > 1e-2
    with pytest.raises(ConfigError, match="floor must be a finite number, got nan"):
        high.prepare(test_clouds[0], floor=float("nan"))
    with pytest.raises(ConfigError, match=r"if these are millimetres, give -1\.25"):
        high(test_clouds[:1], floor=-1250)
    # One whose target stands on z = 0 knows of no floor in other clouds, and is not asked to guess.
    standing = replace(high, result=replace(high.result, floor_m=0.0))
    for ask in (standing, standing.prepare):
        with pytest.raises(ConfigError, match="nothing in these clouds tells where it is: give fl"):
            ask(test_clouds[:1] if ask is standing else test_clouds[0])
    np.testing.assert_array_equal(
        standing(test_clouds[:3], floor=0.5), high(test_clouds[:3], floor=0.5)
    )
    write_result(tmp_path / "result.pt", high.result)
    assert read_result(tmp_path).floor_m == -1.25
    write_result(tmp_path / "result.pt", replace(high.result, floor_m=None))
    with pytest.raises(DataError, match="floor_m: should be a number for scale above_floor"):
        read_result(tmp_path)


def test_what_is_printed_fits_a_line(predictor, metric_run):
    told = "dgcnn, 3 classes: ball, rod, slab; 32 points, scale unit_ball, target kinectsim10"
    assert repr(predictor) == f"Predictor({told}, on cpu)"
    assert repr(predictor.result) == f"Result({told})"
    high = over_the_floor(qs3.load(metric_run)).result
    standing = replace(qs3.load(metric_run, prior={"rod": 2}), result=replace(high, floor_m=0.0))
    assert "scale above_floor, target kinectsim10, needs floor=, with a prior" in repr(standing)


def test_any_number_of_points_any_size_any_place(predictor, test_clouds):
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(n, 3)) for n in (1, 7, 32, 63, 64, 65, 5000)]
    found = predictor(clouds)
    assert found.shape == (7, 3)
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-9)
    moved = [1000 * cloud.astype(np.float32) + 4096 for cloud in test_clouds[:4]]
    np.testing.assert_allclose(predictor(moved), predictor(test_clouds[:4]), atol=2e-2)


def test_few_points_are_repeated_and_many_thinned_as_the_importer_does(predictor):
    rng = np.random.default_rng(1)
    few, many = rng.normal(size=(40, 3)), rng.normal(size=(300, 3))
    repeated = few[np.arange(64) % 40]
    np.testing.assert_array_equal(predictor([few]), predictor([repeated]))
    prepared = predictor.prepare(few)
    assert (prepared.given, len(prepared.points)) == (40, 32)
    from qs3.geometry.sampling import farthest_point_sampling_np

    thinned = many[farthest_point_sampling_np(many.astype(np.float32), 64, 0)]
    np.testing.assert_array_equal(predictor([many]), predictor([thinned]))


@pytest.mark.parametrize(
    ("up", "axes"),
    [
        ("y", lambda c: np.stack([c[:, 0], c[:, 2], -c[:, 1]], 1)),
        ("-y", lambda c: np.stack([c[:, 0], -c[:, 2], c[:, 1]], 1)),
        ("x", lambda c: np.stack([c[:, 2], c[:, 1], -c[:, 0]], 1)),
        ("-x", lambda c: np.stack([-c[:, 2], c[:, 1], c[:, 0]], 1)),
        ("-z", lambda c: np.stack([c[:, 0], -c[:, 1], -c[:, 2]], 1)),
    ],
)
def test_up_turns_the_cloud_back(predictor, test_clouds, up, axes):
    turned = [axes(cloud) for cloud in test_clouds[:6]]  # z of the cloud lies along `up`
    np.testing.assert_allclose(predictor(turned, up=up), predictor(test_clouds[:6]), atol=1e-6)
    assert np.abs(predictor(turned) - predictor(test_clouds[:6])).max() > 1e-3


def test_bad_clouds_are_named(predictor):
    good = np.random.default_rng(0).normal(size=(50, 3))
    bad = good.copy()
    bad[7, 1] = np.nan
    with pytest.raises(DataError, match=r"chair\.xyz, point 8.*not finite"):
        predictor([good, bad], names=["sofa.xyz", "chair.xyz"])
    with pytest.raises(DataError, match="cloud 1: there are no points"):
        predictor([good, good[:0]])
    with pytest.raises(DataError, match=r"cloud 0.*shape"):
        predictor([good[:, :2]])
    with pytest.raises(
        DataError, match=r"cloud 0: the array has shape \(3, 50\): is it transposed"
    ):
        predictor([good.T])
    with pytest.raises(DataError, match=r"cloud 0: .*looks like a depth image, 64 x 48 px"):
        predictor([np.ones((48, 64))])
    with pytest.raises(ConfigError, match=r"^up must be one of"):
        predictor([good], up="w")
    assert predictor([]).shape == (0, 3)


def test_too_few_points_are_fewer_than_the_net_sees(run, tmp_path, predictor):
    """Also where result.pt says how many the files of training had: 64; the net sees 32."""
    assert predictor.result.usual["points"][0] == 64
    cloud = np.random.default_rng(0).normal(size=(64, 3))

    def said(points: int, which=predictor) -> str:
        return "; ".join(which.prepare(cloud[:points]).strange)

    assert "points" not in said(32)
    assert "points 31 is under 32" in said(31)
    usual = {**plain(run)["usual"], "points": [20.0, float("inf")]}
    seen_less = qs3.load(changed(run, tmp_path, usual=usual))
    assert "points" not in said(20, seen_less)
    assert "points 19 is under 20" in said(19, seen_less)


def test_what_is_no_list_of_clouds_is_told(predictor, test_clouds):
    cloud = test_clouds[0]
    for one in (cloud, torch.from_numpy(cloud)):
        with pytest.raises(DataError, match=r"shape \(64, 3\); give a list of clouds"):
            predictor(one)
    for wrong in (None, 7, "scan.xyz"):
        with pytest.raises(DataError, match="give a list of clouds"):
            predictor(wrong)
    with pytest.raises(DataError, match="names: 2 of 1 cloud;"):
        predictor([cloud], names=["a", "b"])
    for wrong in (None, "scan.xyz", [[1, 2, 3], [4, 5]]):
        with pytest.raises(DataError, match=r"cloud 1: .*no .*numbers"):
            predictor([cloud, wrong])
    with pytest.raises(DataError, match=r"point 3: .*leave such points out"):
        predictor([np.where(np.arange(64)[:, None] == 2, np.nan, cloud)])
    expected = predictor([cloud])
    for size in (0, -1, 2.0, None):
        with pytest.raises(ConfigError, match="batch_size must be a whole number >= 1"):
            predictor([cloud], batch_size=size)
    far = np.ma.masked_array(np.vstack([cloud, [[9, 9, 9]]]), mask=False)
    far[-1, 2] = np.ma.masked  # numpy hands the 9 on where an array is asked for
    with pytest.raises(DataError, match="cloud 0: 1 point is masked; leave such points out"):
        predictor([far])
    np.testing.assert_array_equal(predictor([np.ma.compress_rows(far)]), expected)
    np.testing.assert_array_equal(predictor([far[:-1]]), expected)
    tensor = torch.from_numpy(cloud).requires_grad_()
    np.testing.assert_array_equal(predictor([tensor]), expected)
    np.testing.assert_array_equal(predictor([cloud.tolist()]), expected)


def test_the_front_door_says_what_it_takes():
    own, real = (inspect.signature(f).parameters for f in (qs3.load, load))
    assert list(own) == list(real)
    for name in own:
        assert (own[name].kind, own[name].default) == (real[name].kind, real[name].default)
        assert f"{name}:" in qs3.load.__doc__


def test_missing_runs_are_told_apart(run, tmp_path):
    with pytest.raises(MissingDataError, match="is not there"):
        qs3.load(tmp_path / "nothing")
    with pytest.raises(MissingDataError, match=r"a finished run, e\.g\. .*seed0"):
        qs3.load(run.parent)
    with pytest.raises(MissingDataError, match=r"has no result\.pt"):
        qs3.load(tmp_path)
    (tmp_path / "model.onnx").write_bytes(b"a net")
    with pytest.raises(ConfigError, match=r"model\.onnx is a net for other.* exported from"):
        qs3.load(tmp_path / "model.onnx")
    (tmp_path / "started.json").write_text("{}")
    with pytest.raises(MissingDataError, match="not finished"):
        qs3.load(tmp_path)
    with pytest.raises(ConfigError, match="device=quantum"):
        qs3.load(run, device="quantum")


class _Evil:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def test_pickles_are_refused_unopened(run, tmp_path):
    mark = tmp_path / "was_run"
    for file, write in (("a.pt", pickle.dumps), ("b.pt", None)):
        evil = _Evil(mark)
        if write is not None:
            (tmp_path / file).write_bytes(write(evil))
        else:
            torch.save({**plain(run), "classes": evil}, tmp_path / file)
        with pytest.raises(DataError, match="nothing in it was run"):
            qs3.load(tmp_path / file)
    assert not mark.exists()


@pytest.mark.parametrize(
    "model",
    [
        {"_target_": "os.mkdir", "path": "{mark}"},
        {"_target_": "qs3.models.os.mkdir", "path": "{mark}"},
        {"_target_": "qs3.models.base.nn.Linear", "in_features": 1, "out_features": 1},
        {"_target_": "qs3.models.base.DataError"},  # defined elsewhere
        {"_target_": "qs3.models.dgcnn._PooledLinear"},
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": {"_target_": "os.getcwd"}},
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 3, "_partial_": True},
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 3, "_args_": [1]},
        {"_target_": "qs3.models.dgcnn.nothing", "num_classes": 3},
        {"_target_": "qs3.models.nothing.dgcnn", "num_classes": 3},
        {"_target_": "qs3.kernels.norms.head_norm", "kind": "batch"},  # ours, but gives no net
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 3, "colour": "red"},
        {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 3, "k": -1},
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


def test_what_is_wrong_with_a_net_of_ones_own_is_said(run, tmp_path):
    for target, packages, words in (
        (
            "my_nets.MeanNet",
            ("qs3.models",),
            r"refused\. If it is a net of your own, name its pack",
        ),
        ("my_nets.MeanNet", ("qs3.models", "my_nets"), r"No module named 'my_nets'.*Python path"),
        ("tests.training.toy.MeanNet", ("tests",), r"cannot be imported here .*MeanNet"),
        ("qs3.models.dgcnn.MeanNet", ("qs3.models",), "not in this version of qs3"),
    ):
        file = changed(run, tmp_path, model={"_target_": target, "num_classes": 3})
        with pytest.raises(DataError, match=words):
            load(file, packages=packages)


def test_millimetres_are_told_to_python_too(metric_run, run, test_clouds, caplog):
    """A net of metres gave them all one class, with confidence and without a word."""
    clouds = [test_clouds[0], 1000 * test_clouds[1], 100 * test_clouds[2]]
    qs3.load(run)(clouds)
    qs3.load(metric_run)(clouds[:1])
    assert not caplog.records
    qs3.load(metric_run)(clouds)
    assert caplog.messages == [
        "3 clouds: 2 of them as large as if they were not in metres, so these answers mean "
        "nothing: divide millimetres by 1000, centimetres by 100 and inches by 39.37, or leave "
        "out points far from the object"
    ]


@pytest.mark.parametrize("package", ["tests.training", "tests.training.toy"])
def test_a_net_of_ones_own_is_asked_for_by_package_or_module(run, tmp_path, package):
    from tests.training.toy import TinyNet

    torch.manual_seed(0)
    net = TinyNet(3).eval()
    model = {"_target_": "tests.training.toy.TinyNet", "num_classes": 3}
    file = changed(run, tmp_path, model=model, weights=net.state_dict())
    assert isinstance(load(file, packages=package).net, TinyNet)  # a word is one package
    found = load(file, packages=("qs3.models", package))
    assert isinstance(found.net, TinyNet)
    assert not found.net.training
    for name, value in net.state_dict().items():
        assert torch.equal(found.net.state_dict()[name], value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("classes", ["a", "a", "b"]),
        ("classes", ["only"]),
        ("classes", [1, 2, 3]),
        ("points", 0),
        ("points", True),
        ("points", 10**9),
        ("points", 65),  # more than stored
        ("stored_points", "64"),
        ("gravity", "down"),
        ("scale", "feet"),
        ("target", None),
        ("usual", {"spacing": [0.0, float("nan")]}),
        ("usual", {"colour": [0.0, 1.0]}),
        ("usual", [1]),
        ("weights", {"a": 1}),
        ("weights", {}),
        ("weights", {"a": torch.zeros(1)}),
    ],
    ids=str,
)
def test_damaged_values_are_named(run, tmp_path, key, value):
    with pytest.raises(DataError, match=key):
        qs3.load(changed(run, tmp_path, **{key: value}))


def test_lists_within_lists_are_not_followed_for_ever(run, tmp_path):
    """Two to the power of 60 words in a kilobyte: a list twice in a list twice ..."""
    inner: list[Any] = ["a"]
    for _ in range(60):
        inner = [inner, inner]
    file = changed(run, tmp_path, model={"_target_": "qs3.models.dgcnn.dgcnn", "k": inner})
    with time_of_at_most(20), pytest.raises(DataError) as told:
        qs3.load(file)
    assert "plain arguments" in str(told.value)


def test_a_net_that_needs_too_much_memory_is_refused_unbuilt(run, tmp_path):
    """4,000,000 classes take 4 GB; of the right shapes they fit into a small file."""
    model = {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 4_000_000, "k": 6}
    weights = plain(run)["weights"]
    last = [name for name, value in weights.items() if len(value.shape) and value.shape[0] == 3]
    many = {name: weights[name][:1].expand(4_000_000, *weights[name].shape[1:]) for name in last}
    with memory_of_at_most(1 << 29):
        with pytest.raises(DataError, match="weights are not those of"):
            qs3.load(changed(run, tmp_path, model=model))
        with pytest.raises(DataError, match=r"dgcnn takes 4\.1\d GB of memory, more than 2 GB"):
            qs3.load(changed(run, tmp_path, model=model, weights={**weights, **many}))


def test_a_wrong_number_of_classes_is_noticed(run, tmp_path):
    found = qs3.load(changed(run, tmp_path, classes=["a", "b"], held_out=None, learnt=None))
    with pytest.raises(DataError, match="3 classes apart, the file names 2"):
        found([np.eye(3)])


def test_truncated_files_are_damaged(run, tmp_path):
    data = (run / "result.pt").read_bytes()
    for size in (0, 10, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.pt").write_bytes(data[:size])
        with pytest.raises(DataError, match="damaged"):
            qs3.load(tmp_path / "cut.pt")


def test_domain_norms_are_those_of_the_target(run, tmp_path):
    torch.manual_seed(0)
    net = dgcnn(3, k=6, norm="domain")
    for _ in range(3):
        net(torch.randn(4, 32, 3))
    for module in net.modules():
        if getattr(module, "domain", None):
            module.domain = "target"
    net(3 * torch.randn(4, 32, 3))
    model = {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 3, "k": 6, "norm": "domain"}
    found = qs3.load(changed(run, tmp_path, model=model, weights=net.state_dict()))
    cloud = np.random.default_rng(0).normal(size=(64, 3))
    ready = found.prepare(cloud).points[None]
    with torch.no_grad():
        expected = net.eval()(ready).double().softmax(1).numpy()  # still on "target"
    np.testing.assert_allclose(found([cloud]), expected, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    points=st.integers(1, 64),
    gravity=st.sampled_from(["z", "none"]),
    classes=st.lists(st.text(min_size=1), min_size=2, max_size=5, unique=True),
    low=st.floats(allow_nan=False, width=64),
)
def test_written_is_read(tmp_path_factory, run, points, gravity, classes, low):
    import dataclasses

    result = dataclasses.replace(
        read_result(run),
        points=points,
        gravity=gravity,
        classes=tuple(classes),
        usual={"height": [low, float("inf")]},
        held_out=None,  # it has a number for each class
        learnt=(1 / len(classes),) * len(classes),
    )
    file = tmp_path_factory.mktemp("written") / "result.pt"
    write_result(file, result)
    again = read_result(file)
    fields = ("points", "stored_points", "gravity", "classes", "usual", "model", "target", "learnt")
    for field in fields:
        assert getattr(again, field) == getattr(result, field)
    assert all(torch.equal(again.weights[k], v) for k, v in result.weights.items())


def test_importing_qs3_imports_nothing_heavy():
    code = "import qs3, sys; qs3.load; assert not {'torch', 'numpy', 'hydra'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
