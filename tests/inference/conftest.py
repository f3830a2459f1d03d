from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import run_folder
from qs3.inference.model_file import read_result, write_result
from qs3.inference.predictor import Predictor
from qs3.training.command import train
from tests.composing import compose
from tests.running import main
from tests.training.toy import write_toy


@pytest.fixture(scope="session")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two toy domains."""
    folder = tmp_path_factory.mktemp("predict")
    write_toy(folder)
    return folder


@pytest.fixture(scope="session")
def run(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished run: DGCNN, three classes, 32 of 64 points, called from Python."""
    return trained(data_dir, tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="session")
def metric_run(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same on clouds that keep their size."""
    metres = ("data.scale=metres", "data.source.unit=metres")
    return trained(data_dir, tmp_path_factory.mktemp("metric"), *metres)


@pytest.fixture
def high_net(metric_run: Path, tmp_path: Path) -> Path:
    """That net in a file that says it knows heights; see `over_the_floor`."""
    result = read_result(metric_run)
    write_result(tmp_path / "high.pt", replace(result, scale="above_floor", floor_m=-1.25))
    return tmp_path / "high.pt"


def over_the_floor(metric: Predictor) -> Predictor:
    """The same net, as if it knew heights: 1.25 m above the floor in its target."""
    return replace(metric, result=replace(metric.result, scale="above_floor", floor_m=-1.25))


def overrides_of(data_dir: Path, log_dir: Path) -> list[str]:
    """What `run` was trained with."""
    return [
        *("experiment=quickstart", "method=source_only", "selftraining=none"),
        f"paths.data_dir={data_dir}",
        f"paths.log_dir={log_dir}",
        *("num_classes=3", "model.k=6", "data.points=32", "data.fps_starts=1"),
        *("protocol.epochs=1", "protocol.steps=null", "trainer.threads=1"),
        "logger=csv",
        "report.pictures=false",
    ]


def trained(data_dir: Path, log_dir: Path, *more: str) -> Path:
    """Folder of a run with these settings beside `overrides_of`."""
    cfg = compose("train", [*overrides_of(data_dir, log_dir), *more])
    train(cfg)
    return run_folder(cfg)


def table(path: Path) -> list[dict[str, str]]:
    """Rows of a table of predictions."""
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def probabilities(row: dict[str, str]) -> list[float]:
    return [float(value) for key, value in row.items() if key.startswith("p_")]


def predict(run: str | Path, out: Path, *more: str) -> int:
    return main(["predict", f"ckpt={run}", f"out={out}", "threads=2", *more])
