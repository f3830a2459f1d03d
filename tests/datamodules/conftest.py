"""Two small domains on disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.training.toy import write_domain


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 training and 8 test clouds of each of three classes, in two domains."""
    folder = tmp_path_factory.mktemp("data")
    write_domain(folder, "specklenet10", noise=0.05)
    write_domain(folder, "kinectsim10", noise=0.15)
    return folder
