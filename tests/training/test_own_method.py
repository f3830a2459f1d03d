"""A run with a method of a user's file is a run like any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from qs3.config import hashing
from qs3.errors import ConfigError
from qs3.training.command import train
from tests.training.test_unlabelled_target import unlabelled  # noqa: F401 (fixture)

FILE = Path(__file__).parent / "own_method.py"
SHORT = ("selftraining=none", "protocol.epochs=1", "method=own")


def test_on_a_target_without_labels(toy, unlabelled):  # noqa: F811
    metrics = train(toy(*SHORT, f"method.file={FILE}"))
    assert metrics.method == "own_method"
    assert (metrics.final.accuracy, metrics.final.n) == (None, 24)


@pytest.mark.parametrize(
    ("words", "why"),
    [((), " is not set"), (("method.file=no.py",), r"=no\.py cannot be read")],
)
def test_without_a_file_nothing_begins(toy, words, why):
    cfg = toy(*SHORT, *words)
    with pytest.raises(ConfigError, match=rf"^method\.file{why}; method=own needs"):
        train(cfg)
    assert not hashing.run_folder(cfg).exists()


def test_a_misnamed_label_is_a_key_error(toy, tmp_path):
    file = tmp_path / "peeks.py"
    file.write_text(FILE.read_text().replace('source["y_source"]', 'batch["target"]["y_target"]'))
    with pytest.raises(KeyError, match="y_target"):
        train(toy(*SHORT, f"method.file={file}"))
