"""Passes as graphs in whole trainings; without a GPU their memory is played."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from qs3.config.hydra import run_folder
from qs3.engine import cuda_graphs
from qs3.engine.classifier import Classifier
from qs3.runs.checkpoints import load
from qs3.training.command import train
from qs3.training.run import STUDENT
from tests.engine.test_cuda_graphs import Played

POINTNET = ("model._target_=qs3.models.pointnet.pointnet", "+model.variant=basic")


@pytest.mark.slow
@pytest.mark.parametrize("method", [("method=pcm",), ("method=dann", "selftraining=none")])
def test_a_run_is_the_same_with_graphs(
    toy: Any, method: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warm-up and rounds, whose batches have other sizes."""
    config = toy(*POINTNET, *method, "force=true")
    plain = _weights(config)
    monkeypatch.setattr(Played, "made", 0)
    monkeypatch.setattr(cuda_graphs, "EAGER", 1)
    monkeypatch.setattr(cuda_graphs, "captured", Played)
    monkeypatch.setattr(Classifier, "_is_on_one_gpu", lambda self: True)
    graphed = _weights(config)
    assert Played.made >= 2  # in the rounds other ones than in the warm-up; two domains' passes
    assert plain.keys() == graphed.keys()
    assert all(torch.equal(plain[key], graphed[key]) for key in plain)
    made, folder = Played.made, run_folder(config)
    config.trainer.cuda_graphs = False
    assert run_folder(config) == folder  # no result depends on it
    _weights(config)
    assert Played.made == made


def _weights(config: Any) -> dict[str, torch.Tensor]:
    """Of the last student."""
    train(config)
    return load(run_folder(config) / STUDENT)
