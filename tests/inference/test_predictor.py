"""A finished run gives its classifier back, the same to the last digit, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import qs3
from qs3.datamodules.augment import rotate_z
from qs3.datamodules.domain import DomainData
from qs3.errors import ConfigError, DataError
from qs3.evaluation.metrics import predict
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.inference.predictor import resample
from qs3.models.dgcnn import dgcnn
from qs3.runs.predictions import read_predictions
from qs3.store.store import open_pointset
from tests.inference.conftest import over_the_floor


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


def test_a_net_of_heights_needs_the_floor(metric_run, test_clouds):
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
    for wrong in (float("nan"), -1250):  # millimetres
        with pytest.raises(ConfigError):
            high(test_clouds[:1], floor=wrong)
    # One whose target stands on z = 0 knows of no floor in other clouds, and is not asked to guess.
    standing = replace(high, result=replace(high.result, floor_m=0.0))
    for ask in (standing, standing.prepare):
        with pytest.raises(ConfigError):
            ask(test_clouds[:1] if ask is standing else test_clouds[0])
    np.testing.assert_array_equal(
        standing(test_clouds[:3], floor=0.5), high(test_clouds[:3], floor=0.5)
    )


def test_where_the_camera_may_be_anywhere_all_sides_are_averaged(metric_run, test_clouds):
    high = over_the_floor(qs3.load(metric_run))
    seen = replace(high, result=replace(high.result, scale="seen"))
    clouds = test_clouds[:3] + np.float32([2, 3, 0])

    def turned(angle: float) -> np.ndarray:
        turn = [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        return (clouds @ np.array(turn)).astype(np.float32)

    camera = seen(clouds, floor=-1.25)
    np.testing.assert_allclose(seen(turned(1.0), floor=-1.25), camera, atol=1e-3)
    ready = torch.stack([seen.prepare(one, floor=0.0).points for one in clouds])
    sides = [rotate_z(ready, torch.full((3,), k * torch.pi / 4)) for k in range(8)]
    expected = np.mean([predict(seen.net, side, 32) for side in sides], axis=0)
    np.testing.assert_allclose(seen(clouds, floor=0.0), expected, atol=1e-5)


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
    assert len(predictor.prepare(few).points) == 32
    thinned = many[farthest_point_sampling_np(many.astype(np.float32), 64, 0)]
    np.testing.assert_array_equal(predictor([many]), predictor([thinned]))
    z_up = np.stack([thinned[:, 0], -thinned[:, 2], thinned[:, 1]], axis=1)
    np.testing.assert_array_equal(resample(many, 64, "y"), z_up.astype(np.float32))


@pytest.mark.parametrize(
    ("up", "columns", "signs"),
    [
        ("y", (0, 2, 1), (1, 1, -1)), ("-y", (0, 2, 1), (1, -1, 1)), ("x", (2, 1, 0), (1, 1, -1)),
        ("-x", (2, 1, 0), (-1, 1, 1)), ("-z", (0, 1, 2), (1, -1, -1)),
    ],
)  # fmt: skip
def test_up_turns_the_cloud_back(predictor, test_clouds, up, columns, signs):
    turned = test_clouds[:6][..., columns] * np.float32(signs)  # z of the cloud lies along `up`
    np.testing.assert_allclose(predictor(turned, up=up), predictor(test_clouds[:6]), atol=1e-6)
    assert np.abs(predictor(turned) - predictor(test_clouds[:6])).max() > 1e-3


def test_bad_clouds_are_named(predictor):
    good = np.random.default_rng(0).normal(size=(50, 3))
    bad, hidden = good.copy(), np.ma.masked_array(good, mask=good > 2.0)
    bad[7, 1] = np.nan
    zeros = np.vstack([good, np.zeros((5, 3))])
    assert hidden.mask.any()
    for cloud in (bad, good[:0], good[:, :2], good.T, np.ones((48, 64)), hidden, zeros, ["a"]):
        with pytest.raises(DataError, match=r"chair\.xyz"):
            predictor([good, cloud], names=["sofa.xyz", "chair.xyz"])
    with pytest.raises(DataError):
        predictor(good)
    assert predictor([]).shape == (0, 3)
    expected = predictor([good])
    for same in (torch.from_numpy(good).requires_grad_(), good.tolist(), np.ma.masked_array(good)):
        np.testing.assert_array_equal(predictor([same]), expected)


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


def test_millimetres_are_told_to_python_too(metric_run, run, test_clouds, caplog):
    """Of a net of metres they all get one class, with confidence."""
    clouds = [test_clouds[0], 1000 * test_clouds[1], 100 * test_clouds[2]]
    qs3.load(run)(clouds)
    qs3.load(metric_run)(clouds[:1])
    assert not caplog.records
    qs3.load(metric_run)(clouds)
    assert "2 are too large for metres" in caplog.text


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


def test_importing_qs3_imports_nothing_heavy():
    code = "import qs3, sys; assert not {'torch', 'numpy', 'hydra'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
