"""`model=features`: a file's net, its features kept by content, and what is refused."""

from __future__ import annotations

import copy
import hashlib
import logging

import numpy as np
import pytest
import torch

from qs3.datamodules.clouds import Clouds
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.methods.base import feature_dims
from qs3.models.features import Encoder, features, remember
from tests.models.onnx_files import weights, write_encoder


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def made(path, **settings):
    return features(4, str(path), sha256(path), **settings)


def twin(points, dim=6, seed=0):
    """The file's net in numpy."""
    return np.maximum(points @ weights(dim, seed), 0).max(axis=1)


@pytest.fixture
def clouds():
    """Seven clouds of nine points, each in two samples of five."""
    rng = np.random.default_rng(1)
    order = np.stack([[rng.permutation(9)[:5] for _ in range(2)] for _ in range(7)])
    return Clouds.of(rng.normal(size=(7, 9, 3)).astype(np.float32), order)


def test_it_is_the_file_s_net_and_a_head(tmp_path):
    net = made(write_encoder(tmp_path / "a.onnx"), hidden=()).eval()
    points = torch.randn(5, 11, 3)
    found = net.features(points)
    np.testing.assert_allclose(found.global_, twin(points.numpy()), atol=1e-5)
    assert found.per_point is None
    torch.testing.assert_close(net(points), net.head[0](found.global_))
    assert feature_dims(net) == (6, None)
    assert {name.split(".")[0] for name in net.state_dict()} == {"head"}
    assert sum(p.numel() for p in net.parameters()) == 6 * 4 + 4
    assert copy.deepcopy(net).backbone.encoder is net.backbone.encoder
    assert len(made(tmp_path / "a.onnx", hidden=(8, 5)).head) == 9


def test_instance_norm_is_refused(tmp_path):
    """It was batch norm under another name."""
    with pytest.raises(ConfigError, match=r"^model\.norm=instance .* set model\.norm=batch or dom"):
        made(write_encoder(tmp_path / "a.onnx"), norm="instance")


def test_features_are_computed_once_and_kept(tmp_path, clouds, monkeypatch):
    asked = []
    real = Encoder.compute
    monkeypatch.setattr(Encoder, "compute", lambda self, x: asked.append(len(x)) or real(self, x))
    first = made(write_encoder(tmp_path / "a.onnx"))
    remember(first, [clouds], tmp_path)
    assert sum(asked) == 14
    (file,) = (tmp_path / "features").iterdir()
    each = [clouds.take(torch.arange(7), torch.full((7,), s)) for s in (0, 1)]
    for batch in each:
        np.testing.assert_allclose(first.features(batch).global_, twin(batch.numpy()), atol=1e-5)
    assert sum(asked) == 14
    other = torch.randn(2, 5, 3)  # a cloud of none of them is computed, and not kept
    mixed = first.features(torch.cat([each[1][:2], other, each[0][:1]])).global_
    np.testing.assert_allclose(mixed[2:4], twin(other.numpy()), atol=1e-5)
    assert asked[-1] == 2
    assert len(first.backbone.encoder.known) == 14

    def again(path, seed=0):
        asked.clear()
        encoder = Encoder(path.read_bytes(), sha256(path), "x")
        encoder.remember(clouds, tmp_path)
        expected = twin(each[1].numpy(), seed=seed)
        np.testing.assert_allclose(encoder(each[1].numpy()), expected, atol=1e-5)
        return sum(asked)

    assert again(tmp_path / "a.onnx") == 0
    file.write_bytes(file.read_bytes()[:-40] + bytes(40))
    assert again(tmp_path / "a.onnx") == 14  # damaged: made again
    assert again(tmp_path / "a.onnx") == 0
    assert again(write_encoder(tmp_path / "b.onnx", seed=3), seed=3) == 14  # another net
    assert len(list((tmp_path / "features").iterdir())) == 2


def test_without_a_folder_nothing_is_written(tmp_path, clouds):
    net = made(write_encoder(tmp_path / "a.onnx", seed=5))
    remember(net, [clouds], None)
    assert len(net.backbone.encoder.known) == 14
    assert [path.name for path in tmp_path.iterdir()] == ["a.onnx"]


def _bytes(path):
    path.write_bytes(b"\x80\x04no net at all" * 9)
    return path


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (_bytes, "not an ONNX file, or damaged|cannot be run by onnxruntime"),
        (lambda p: write_encoder(p, external=True), "keeps weights in files beside it"),
        (lambda p: write_encoder(p, inputs=["mask"]), "has 2 inputs and 1 output"),
        (
            lambda p: write_encoder(p, some=True, out=["b", "d"]),
            r"its output is \['b', .*a known D",
        ),
    ],
)
def test_files_that_are_refused(tmp_path, write, message):
    path = write(tmp_path / "a.onnx")
    with pytest.raises(DataError, match=message) as caught:
        made(path)
    assert "a.onnx" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": np.inf}, "expected finite float32"),
        ({"axes": [0], "out": ["n", 6]}, r"gave float32 \[9, 6\] for clouds \[4, 9, 3\]"),
    ],
)
def test_features_that_are_refused(tmp_path, changes, message):
    net = made(write_encoder(tmp_path / "a.onnx", **changes))
    with pytest.raises(DataError, match=message):
        net.features(torch.randn(4, 9, 3))


def test_a_truncated_file_raises_nothing_but_our_errors(tmp_path):
    whole = write_encoder(tmp_path / "a.onnx").read_bytes()
    refused = 0
    for cut in range(0, len(whole), 7):
        path = tmp_path / "cut.onnx"
        path.write_bytes(whole[:cut])
        try:
            made(path).features(torch.randn(2, 5, 3))
        except Qs3Error:
            refused += 1
    assert refused == len(range(0, len(whole), 7))


def test_another_file_than_was_meant(tmp_path, monkeypatch):
    path = write_encoder(tmp_path / "a.onnx")
    with pytest.raises(ConfigError, match="is another file than the one that was meant"):
        features(4, str(path), "0" * 64)
    with pytest.raises(ConfigError, match="is not there; model=features needs an ONNX file"):
        features(4, str(tmp_path / "no.onnx"), "0" * 64)
    monkeypatch.setenv("QS3_MEMORY_GB", "1e-7")
    with pytest.raises(DataError, match="more than 1e-07 GB: refused"):
        features(4, str(path), "1" * 64)


def test_it_says_when_it_computes(tmp_path, clouds, caplog):
    net = made(write_encoder(tmp_path / "a.onnx", seed=6))
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            remember(net, [clouds], tmp_path)
    assert caplog.text.count("features of 14 clouds by model.file=") == 1
