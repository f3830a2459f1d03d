"""Exported nets give the same logits; nets that cannot be exported say so."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

import qs3
from qs3.errors import Qs3Error
from qs3.inference import Predictor
from qs3.models.dgcnn import dgcnn
from qs3.models.pointdan import pointdan
from qs3.models.pointnet import pointnet
from qs3.models.rscnn import rscnn
from qs3.models.simpleview import simpleview
from qs3.predict.__main__ import main
from qs3.predict.export import export
from qs3.result import Result

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def predictor_of(net: nn.Module, points: int = 64) -> Predictor:
    model = {"_target_": "qs3.models.test"}
    result = Result(model, ("a", "b", "c"), points, points, "made", "z", {}, {})
    for module in net.modules():  # norms that do something
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 2)
    return Predictor(net.eval(), result, torch.device("cpu"))


def test_the_command_and_the_file_without_qs3(run, tmp_path, capsys):
    out = tmp_path / "model.pt2"
    assert main(["export", f"ckpt={run}", f"out={out}", "batch_size=2", "threads=1"]) == 0
    assert "differ by at most" in capsys.readouterr().out
    predictor = qs3.load(run)
    rng = np.random.default_rng(0)
    ready = torch.stack([predictor.prepare(rng.normal(size=(70, 3))).points for _ in range(2)])
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


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: dgcnn(3, k=5, variant="simpleview"), marks=pytest.mark.slow),
        lambda: dgcnn(3, k=5, norm="instance"),
        pytest.param(lambda: dgcnn(3, k=5, norm="domain"), marks=pytest.mark.slow),
        lambda: pointnet(3),
        pytest.param(lambda: dgcnn(3, k=5, variant="defrec"), marks=pytest.mark.slow),
        pytest.param(lambda: simpleview(3, image_size=32), marks=pytest.mark.slow),
        pytest.param(lambda: pointdan(3, nodes=8, neighbours=8), marks=pytest.mark.slow),
    ],
    ids=["simpleview's", "instance", "domain", "pointnet", "defrec", "simpleview", "pointdan"],
)
def test_nets_that_can_be_exported(make, tmp_path):
    torch.manual_seed(0)
    assert export(predictor_of(make()), tmp_path / "net.pt2") <= 1e-4
    assert (tmp_path / "net.pt2").is_file()


@pytest.mark.slow
def test_a_net_that_cannot_says_so(tmp_path):
    with pytest.raises(Qs3Error, match=r"cannot export qs3\.models\.test"):
        export(predictor_of(rscnn(3), 600), tmp_path / "net.pt2")
    assert list(tmp_path.iterdir()) == []


def test_other_logits_are_refused(tmp_path):
    class Forgetful(nn.Module):
        """Does something else while it is exported."""

        def __init__(self) -> None:
            super().__init__()
            self.layer = nn.Linear(3, 3)

        def forward(self, points: torch.Tensor) -> torch.Tensor:
            logits = self.layer(points.mean(1))
            return logits + 2e-4 if torch.compiler.is_exporting() else logits

    with pytest.raises(Qs3Error, match=r"more than 0\.0001"):
        export(predictor_of(Forgetful()), tmp_path / "net.pt2")
    assert list(tmp_path.iterdir()) == []
