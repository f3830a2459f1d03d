"""A run whose net is a head on the frozen features of a file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import qs3
from qs3.config.hydra import run_folder
from qs3.errors import ConfigError
from qs3.inference.export import export_file, export_folder
from qs3.models import features
from qs3.models.features import Encoder
from qs3.runs.checkpoints import load
from qs3.training.command import train
from qs3.training.load import read_given
from tests.models.onnx_files import write_encoder
from tests.training.conftest import result_of
from tests.training.toy import overrides
from tests.training.watching import interrupt

UNTURNED = ("protocol.augment.rotate_z=false", "protocol.augment.jitter_sigma=0")


@pytest.fixture
def frozen(toy_data, tmp_path):
    """Composes a run of `model=features` with a random net of 16 features."""
    from tests.composing import compose

    write_encoder(tmp_path / "net.onnx", dim=16)
    words = [word for word in overrides(tmp_path) if "model." not in word]

    def config(*more, file=tmp_path / "net.onnx"):
        own = ("model=features", f"model.file={file}", "model.hidden=[8]", *UNTURNED)
        paths = (f"paths.data_dir={toy_data}", f"paths.cache_dir={tmp_path / 'cache'}")
        return compose("train", [*words, *own, *paths, "protocol.epochs=4", *more])

    return config


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [("method=source_only",), ("method=pcfea", "selftraining=none")], ids=" ".join
)
def test_a_run_is_computed_once_goes_on_and_is_loaded(frozen, tmp_path, monkeypatch, words):
    asked, real = [], Encoder.compute
    monkeypatch.setattr(Encoder, "compute", lambda self, x: asked.append(len(x)) or real(self, x))
    words = (*words, "model.dropout=0.1")
    cfg = frozen(*words, f"paths.log_dir={tmp_path / 'whole'}")
    metrics = train(cfg)
    assert metrics.warmup.last.scores.accuracy > 0.6  # 0.33 by chance
    assert len(list((tmp_path / "cache" / "features").iterdir())) == 3
    # 72 clouds for training of source and target in four samples, and 24 for tests; nothing in all
    # epochs and pools; then the turned ones by which a run estimates its accuracy.
    pieces = [32, 32, 8] * 4
    assert asked[:25] == [*pieces, *pieces, 24]
    assert set(asked[25:]) <= {24}
    asked.clear()
    broken = frozen(*words, f"paths.log_dir={tmp_path / 'broken'}")
    interrupt(broken, epoch=2)
    assert asked == []  # features were there
    train(broken)
    folder = run_folder(cfg)
    assert result_of(run_folder(broken)) == result_of(folder)
    assert all(name.startswith("head.") for name in load(folder / "student.pt"))
    assert qs3.load(folder).probabilities(torch.randn(3, 64, 3)).shape == (3, 3)
    (tmp_path / "net.onnx").rename(tmp_path / "moved.onnx")
    again = frozen(*words, f"paths.log_dir={tmp_path / 'whole'}", file=tmp_path / "moved.onnx")
    assert run_folder(again) == folder


def test_the_file_is_found_from_another_folder(frozen, tmp_path, monkeypatch):
    """It was looked for below the folder that a reader stands in, and not where it was."""
    words = ("method=source_only", "selftraining=none", "protocol.epochs=1")
    monkeypatch.chdir(tmp_path)
    cfg = frozen(*words, file="net.onnx")
    train(cfg)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    folder = run_folder(cfg)
    features._encoder.cache_clear()  # as in another process
    assert qs3.load(folder).probabilities(torch.randn(3, 64, 3)).shape == (3, 3)
    for how, out in ((export_file, "net.pt2"), (export_folder, "folder")):
        with pytest.raises(ConfigError):
            how(folder, Path(out))
    assert list((tmp_path / "elsewhere").iterdir()) == []
    (tmp_path / "net.onnx").rename(tmp_path / "moved.onnx")  # another run begins with it
    again = frozen(*words, f"weights={folder}", file=tmp_path / "moved.onnx")
    assert read_given(again) is not None


def test_a_method_that_trains_features_is_refused(frozen):
    with pytest.raises(ConfigError, match="method=dann trains a net's features, and this model's"):
        train(frozen("method=dann", "selftraining=none"))
