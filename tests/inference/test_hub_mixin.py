"""Folders of classifiers through huggingface_hub's own mixin, without a network."""

from __future__ import annotations

import json
import shutil
import socket
from typing import Any

import pytest
import torch
from huggingface_hub import PyTorchModelHubMixin
from hydra.utils import instantiate
from torch import nn

import qs3
from qs3.inference import pretrained
from qs3.inference.model_file import build_net, read_result
from qs3.inference.model_folder import CONFIG, WEIGHTS


class HubClassifier(nn.Module, PyTorchModelHubMixin, library_name="qs3"):
    """What a user writes to have `from_pretrained` and `push_to_hub` from config.json's values."""

    def __init__(self, model: dict[str, Any], classes: list[str], **more: Any) -> None:
        super().__init__()
        self.classes, self.more = classes, more
        self._net = [instantiate(model)]  # in a list, so that its weights keep their names
        for name, child in self._net[0].named_children():
            self.add_module(name, child)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self._net[0](points)


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refused(*_, **__):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket, "create_connection", refused)
    monkeypatch.setattr(socket.socket, "connect", refused)


def clouds():
    return torch.randn(3, 512, 3, generator=torch.Generator().manual_seed(0)) / 2


@pytest.mark.parametrize("name", pretrained.names())
def test_the_mixin_loads_what_comes_with_qs3(name):
    folder = pretrained.folder_of(name)
    hub = HubClassifier.from_pretrained(str(folder), strict=True).eval()
    assert tuple(hub.classes) == qs3.load(name).classes
    assert hub.more["points"] == qs3.load(name).points
    ours = build_net(read_result(folder))
    for key, value in ours.state_dict().items():
        assert torch.equal(hub.state_dict()[key], value), key
    with torch.inference_mode():
        torch.testing.assert_close(hub(clouds()), ours(clouds()))


def test_what_the_mixin_saves_is_a_classifier_of_qs3_but_for_its_hash(tmp_path):
    """`push_to_hub` uploads what `save_pretrained` writes."""
    name = "pointnet-speckle"
    folder = pretrained.folder_of(name)
    hub = HubClassifier.from_pretrained(str(folder), strict=True)
    hub.save_pretrained(tmp_path)
    saved, kept = (json.loads((path / CONFIG).read_text()) for path in (tmp_path, folder))
    for key in ("model", "classes", "points", "scale", "gravity", "usual"):
        assert saved[key] == kept[key]
    assert (tmp_path / WEIGHTS).stat().st_size > 1e6
    # The mixin writes 32 bits; the hash in config.json is that of the 16 bits it read.
    shutil.copy(folder / WEIGHTS, tmp_path / WEIGHTS)
    assert qs3.load(tmp_path).classes == qs3.load(name).classes
