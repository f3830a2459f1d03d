"""One's own folders of clouds, from files to a result; a target without labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig

from qs3.config import hashing
from qs3.errors import ConfigError
from qs3.runs.metrics import read_metrics
from qs3.training.command import train
from tests.composing import compose
from tests.training.toy import _SHAPES, overrides


def write_clouds(folder: Path, count: int, noise: float, labels: bool) -> None:
    """Text files of 40 to 80 points: class/name.xyz, or name.txt without labels."""
    rng = np.random.default_rng(count)
    for cls, shape in _SHAPES.items():
        for i in range(count):
            points = rng.normal(size=(int(rng.integers(40, 80)), 3)) * shape
            points += noise * rng.normal(size=points.shape)
            path = folder / f"{cls}_{i:02d}.txt"
            if labels:
                path = folder / cls.capitalize() / f"{i:02d}.xyz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(path, points, fmt="%.5f")


def config(root: Path, *more: str) -> DictConfig:
    own = [
        *("domain@data.source=own", "domain@data.target=own"),
        f"data.source.published.folder={root / 'labelled'}",
        f"data.target.published.folder={root / 'scans'}",
        *(f"data.{d}.path={root / 'data' / d}" for d in ("source", "target")),
        *(f"data.{d}.published.points=48" for d in ("source", "target")),
        *(f"data.{d}.classes=[ball,rod,slab]" for d in ("source", "target")),
    ]
    return compose("train", overrides(root, *own, *more))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_clouds(tmp_path / "labelled", 20, 0.05, labels=True)
    write_clouds(tmp_path / "scans", 12, 0.15, labels=False)
    return tmp_path


def test_own_labels_are_an_upper_bound_or_refused(root: Path) -> None:
    with pytest.raises(ConfigError, match="labels"):
        train(config(root, "method=supervised", "selftraining=none"))
    labelled = f"data.target.published.folder={root / 'labelled'}"
    other = f"data.target.path={root / 'data' / 'labelled'}"
    name = "experiment_name=bound"
    cfg = config(root, "method=supervised", "selftraining=none", labelled, other, name)
    metrics = train(cfg)
    assert metrics == read_metrics(hashing.run_folder(cfg))
    assert metrics.final.n == 12  # every fifth of 3 times 20
    assert metrics.final.accuracy > metrics.final.majority_rate
