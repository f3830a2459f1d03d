"""`model=features`: a file's net, its features kept by content, and what is refused."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch

from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError
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


def _bytes(path):
    path.write_bytes(b"\x80\x04no net at all" * 9)
    return path


@pytest.mark.parametrize("write", [_bytes, lambda p: write_encoder(p, inputs=["mask"])])
def test_files_that_are_refused(tmp_path, write):
    path = write(tmp_path / "a.onnx")
    with pytest.raises(DataError, match=r"a\.onnx"):
        made(path)


def test_what_would_be_silently_wrong_is_refused(tmp_path):
    """Another file than was meant, features that are no numbers, a maximum over the clouds."""
    path = write_encoder(tmp_path / "a.onnx")
    with pytest.raises(DataError, match=r"a\.onnx"):
        features(4, str(path), "0" * 64)
    for changes in ({"scale": np.inf}, {"axes": [0], "out": ["n", 6]}):
        net = made(write_encoder(path, **changes))
        with pytest.raises(DataError):
            net.features(torch.randn(4, 9, 3))
