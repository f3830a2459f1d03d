"""Exported nets give the same logits, for any number of clouds; what cannot be exported says so."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

import qs3
from qs3.errors import Qs3Error
from qs3.inference.export import any_points, compared, export, made_up, metadata
from qs3.inference.model_file import Result
from qs3.inference.predictor import Predictor
from qs3.models.base import PointClassifier
from qs3.models.committee import committee
from qs3.models.dgcnn import dgcnn
from qs3.models.frontview import frontview
from qs3.models.pointdan import pointdan
from qs3.models.pointnet import pointnet
from qs3.models.pointnet2 import pointnet2
from qs3.models.rscnn import rscnn
from qs3.models.simpleview import simpleview
from tests.inference.conftest import over_the_floor
from tests.running import main

# ONNX's script decorator and torch's tree of arguments use what Python and torch call old.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*LeafSpec:FutureWarning", "ignore::DeprecationWarning:onnxscript"
)

DOCS = Path(__file__).parents[2] / "docs" / "how-to" / "predict.md"


def predictor_of(net: nn.Module, points: int = 64) -> Predictor:
    """With norms and heads that do something: untrained logits hardly differ between clouds."""
    model = {"_target_": "qs3.models.test"}
    result = Result(model, ("a", "b", "c"), points, points, "made", "z", "unit_ball", {}, {})
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.3, 1.0)
            module.weight.data.uniform_(-1, 1)  # a negative scale turns a maximum round
    net.eval()
    if isinstance(net, PointClassifier):
        with torch.no_grad():
            logits = net(made_up(points, 6))
            for layer in net.head.modules():
                if isinstance(layer, nn.Linear) and layer.out_features == 3:
                    layer.weight.data /= (logits - logits.mean(0)).abs().max()
    return Predictor(net, result, torch.device("cpu"))


NETS = {
    "dgcnn": (lambda: dgcnn(3, k=5), 64),
    "dgcnn instance": (lambda: dgcnn(3, k=5, norm="instance"), 64),
    "dgcnn domain": (lambda: dgcnn(3, k=5, norm="domain"), 64),
    "dgcnn defrec": (lambda: dgcnn(3, k=5, variant="defrec"), 64),
    "dgcnn few points": (lambda: dgcnn(3, k=20), 16),
    "pointnet": (lambda: pointnet(3), 64),
    "pointnet basic": (lambda: pointnet(3, variant="basic", norm="instance"), 64),
    "pointnet uda": (lambda: pointnet(3, variant="uda", norm="instance"), 64),
    "simpleview": (lambda: simpleview(3, image_size=32), 64),
    "simpleview nearest": (lambda: simpleview(3, image_size=32, pixel="nearest", up="z"), 64),
    "frontview": (lambda: frontview(3, image_size=16), 64),
    "committee": (lambda: committee(3), 64),
    "pointdan": (lambda: pointdan(3, nodes=8, neighbours=8), 64),
    "pointnet2 ssg": (lambda: pointnet2(3, variant="ssg"), 600),
    "pointnet2 msg": (lambda: pointnet2(3), 600),
    # 800: clouds that repeat a third of their points have more different ones than 512 centres.
    # With fewer, which of them become centres twice is open, and these norms count centres.
    "pointnet2 instance": (lambda: pointnet2(3, variant="ssg", norm="instance"), 800),
    "rscnn released": (lambda: rscnn(3), 600),
    "rscnn paper": (lambda: rscnn(3, relation="paper"), 600),
    "rscnn instance": (lambda: rscnn(3, norm="instance"), 800),
}


EACH = [pytest.param(name, marks=[pytest.mark.slow] * (name != "pointnet basic")) for name in NETS]


@pytest.mark.parametrize("name", EACH)
def test_onnxruntime_gives_the_net_s_logits(name, tmp_path):
    make, points = NETS[name]
    torch.manual_seed(0)
    predictor = predictor_of(make(), points)
    export(predictor, tmp_path / "net.onnx", 6)
    net = onnxruntime.InferenceSession(
        tmp_path / "net.onnx", providers=["CPUExecutionProvider"]
    )  # the names and the numbers of clouds and points, as another program would use them
    free = ["clouds", "points", 3] if any_points(predictor) else ["clouds", points, 3]
    assert net.get_inputs()[0].shape == free
    assert any_points(predictor) == ("few" not in name)
    about = net.get_modelmeta().custom_metadata_map
    assert json.loads(about["classes"]) == ["a", "b", "c"]
    assert (about["points"], about["up"], about["qs3"]) == (str(points), "z", qs3.__version__)
    assert str(Path.home()) not in str(about)
    pairs = []
    for clouds, more in ((1, 0), (5, 0), (3, 9)):
        if more and not any_points(predictor):
            continue
        x = made_up(points + more, 2 * clouds)[1::2]  # boxes, without repeated points
        (logits,) = net.run(["logits"], {"points": x.numpy()})
        with torch.no_grad():
            pairs.append((logits, predictor.net(x).numpy()))
    if "instance" in name and points > 64:
        # Their norms divide by small deviations: of these clouds one differs by 3e-4, where the
        # net itself is within 1e-5 of float64. So the rule that export has for all nets.
        assert compared(*map(np.concatenate, zip(*pairs, strict=True)))[0]
        return
    for theirs, ours in pairs:
        assert np.abs(theirs - ours).max() <= 1e-4


@pytest.mark.parametrize("name", EACH)
def test_torch_export_gives_the_net_s_logits(name, tmp_path):
    make, points = NETS[name]
    torch.manual_seed(0)
    predictor = predictor_of(make(), points)
    assert "on 6 clouds" in export(predictor, tmp_path / "net.pt2", 6)


@pytest.mark.slow
def test_the_command_and_the_pt2_file_without_qs3(run, tmp_path, capsys):
    out = tmp_path / "model.pt2"
    assert main(["export", f"ckpt={run}", f"out={out}"]) == 0
    assert "(largest)" in capsys.readouterr().out
    predictor = qs3.load(run)
    rng = np.random.default_rng(0)
    ready = torch.stack([predictor.prepare(rng.normal(size=(70, 3))).points for _ in range(3)])
    with torch.no_grad():
        expected = predictor.net(ready)
    torch.save({"ready": ready, "expected": expected}, tmp_path / "clouds.pt")
    code = """
import sys, torch, warnings
warnings.simplefilter("ignore")
net = torch.export.load("model.pt2").module()
clouds = torch.load("clouds.pt", weights_only=True)
assert (net(clouds["ready"]) - clouds["expected"]).abs().max() <= 1e-4
assert not any(name.startswith("qs3") for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["run", "metric_run"])
def test_the_example_of_the_document_needs_numpy_and_onnxruntime_alone(
    which, request, tmp_path, capsys
):
    """The lines of docs/how-to/predict.md, run as they stand; the same probabilities as ours."""
    run = request.getfixturevalue(which)
    predictor = qs3.load(run)
    stored = predictor.result.stored_points
    out = tmp_path / "model.onnx"
    assert main(["export", f"ckpt={run}", f"out={out}"]) == 0
    assert "logits on 32 clouds differ" in capsys.readouterr().out
    text = DOCS.read_text(encoding="utf-8")
    code = text.split("```python\n")[1].split("```")[0]
    assert "qs3" not in code
    for count in (stored, stored - 30, 2 * stored):  # filled up and thinned, as training's were
        cloud = np.random.default_rng(3).normal(size=(count, 3)) ** 2
        np.savetxt(tmp_path / "scan.xyz", cloud)
        found = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout.split()
        ours = predictor([np.loadtxt(tmp_path / "scan.xyz")])[0]
        assert found[0] == predictor.classes[ours.argmax()]
        assert float(found[1]) == pytest.approx(ours.max(), abs=1e-4)


def test_the_file_of_a_net_of_metres_says_so(run, metric_run):
    """The rows that the example in the document lacks: what to do with a cloud before."""
    ball, metres = metadata(qs3.load(run)), metadata(qs3.load(metric_run))
    assert ball["unit"].startswith("none")
    assert ball["normalisation"].endswith("divide by the largest distance from it")
    assert metres["unit"] == "metre: clouds keep their size"
    assert metres["normalisation"] == "subtract the mean of the points"
    assert {name for name in ball if ball[name] != metres[name]} == {"unit", "normalisation"}
    high = metadata(over_the_floor(qs3.load(metric_run)))
    assert high["normalisation"].endswith("from x and y, and the floor's height from z")


class Waits(nn.Module):
    """What it does depends on values."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 3)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        logits = self.layer(points.mean(1))
        return logits if float(points.sum()) > 1e9 else 2 * logits


class Forgetful(nn.Module):
    """Does something else while it is exported."""

    def __init__(self, error: float) -> None:
        super().__init__()
        self.layer, self.error = nn.Linear(3, 3), error

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        logits = self.layer(points.mean(1))
        return logits + self.error if torch.compiler.is_exporting() else logits


@pytest.mark.parametrize(
    ("net", "suffix"),
    [
        pytest.param(Waits(), "onnx", marks=pytest.mark.slow),
        (Waits(), "pt2"), (Forgetful(2e-4), "onnx"),
        (Forgetful(float("nan")), "pt2"), (Waits(), "h5"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_leaves_no_file(tmp_path, net, suffix):
    with pytest.raises(Qs3Error):
        export(predictor_of(net), tmp_path / f"net.{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_single_clouds_may_differ_but_not_many():
    ours = np.zeros((40, 3))
    theirs = ours + 1e-6
    theirs[3] = 0.02  # a neighbour that is equally far
    agrees, words = compared(theirs, ours)
    assert agrees
    assert "1 by more than 0.0001" in words
    theirs[:5] = 0.02
    assert not compared(theirs, ours)[0]
    assert not compared(np.full((1, 3), np.nan), ours[:1])[0]
