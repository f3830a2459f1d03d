from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config import hashing
from qs3.training.command import train
from tests.training.toy import toy_config, write_toy


@pytest.fixture(scope="session")
def toy_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder `data` with the two toy domains, written once."""
    folder = tmp_path_factory.mktemp("toy")
    write_toy(folder / "data")
    return folder / "data"


@pytest.fixture
def toy(toy_data: Path, tmp_path: Path):
    """Composes the config of a toy run whose logs lie in this test's folder."""

    def config(*more: str) -> Any:
        return toy_config(tmp_path, f"paths.data_dir={toy_data}", *more)

    return config


@pytest.fixture(scope="session")
def finished(toy_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the toy run with seed 0, never interrupted."""
    cfg = toy_config(tmp_path_factory.mktemp("finished"), f"paths.data_dir={toy_data}")
    train(cfg)
    return hashing.run_folder(cfg)


def result_of(folder: Path) -> dict[str, Any]:
    """All that must not differ between two runs of the same config."""
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics.pop("times")
    metrics["versions"].pop("commit", None)  # a file may be edited between the two
    files = ["history.csv", *(str(p.relative_to(folder)) for p in folder.glob("round_*/*.csv"))]
    return {"metrics": metrics, **{name: (folder / name).read_text() for name in sorted(files)}}
