"""Targets of somebody's own: without labels, without a test split, in other units."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qs3.config.hydra import run_folder
from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError
from qs3.runs.metrics import read_metrics
from qs3.store.meta import ManifestRow
from qs3.store.store import PointSet, open_pointset, write_pointset
from qs3.training.command import headline, train
from qs3.training.load import check_real_sizes
from tests.training.toy import CLASSES


def without_labels(dataset: PointSet) -> PointSet:
    return dataclasses.replace(dataset, labels=np.full(len(dataset), -1, dtype=np.int64))


@pytest.fixture
def unlabelled(monkeypatch):
    """The toy target is opened without its labels."""
    import qs3.datasets.domain

    def opened(folder, *args, **kwargs):
        dataset = open_pointset(folder, *args, **kwargs)
        return without_labels(dataset) if Path(folder).name == "kinectsim10" else dataset

    monkeypatch.setattr(qs3.datasets.domain, "open_pointset", opened)


def only(toy_data: Path, folder: Path, keep) -> Path:
    """The toy data with those target clouds of which `keep(row)` is true."""
    folder.mkdir()
    (folder / "specklenet10").symlink_to(toy_data / "specklenet10")
    old = open_pointset(toy_data / "kinectsim10")
    rows = [
        ManifestRow(id=i, cls=CLASSES[y], split=s)
        for i, y, s in zip(old.ids, old.labels, old.splits, strict=True)
    ]
    kept = [i for i, row in enumerate(rows) if keep(row)]
    write_pointset(
        folder / "kinectsim10",
        name="kinectsim10",
        classes=CLASSES,
        arrays={"points": old.points[kept]},
        rows=[rows[i] for i in kept],
        meta={},
    )
    return folder


@pytest.mark.parametrize("more", [("selftraining=none",), ()])
def test_own_scans_without_labels(toy, unlabelled, finished, more):
    cfg = toy(*more)
    metrics = train(cfg)
    final = metrics.final
    assert final.accuracy is final.balanced_accuracy is final.majority_rate is None
    assert final.per_class_recall is final.confusion is final.calibration_error is None
    assert final.n == sum(final.predicted.values()) == 24
    assert set(final.predicted) == set(CLASSES)
    assert metrics.evaluation.labels is False
    assert metrics.evaluation.split == "test"
    assert all(record.with_target_labels is None for record in metrics.rounds)
    if "selftraining=none" not in more:  # labels or not, training does the same
        theirs = read_metrics(finished)
        assert final.predicted == theirs.final.predicted
    assert "no labels to judge kinectsim10 (simulated) by; predicted " in headline(metrics)
    assert train(cfg) == metrics == read_metrics(run_folder(cfg))


def test_without_a_test_split_predictions_of_the_training_clouds_are_counted(
    toy, toy_data, tmp_path, caplog
):
    data = only(toy_data, tmp_path / "cut", lambda row: row.split == "train")
    metrics = train(toy(f"paths.data_dir={data}", "selftraining.rounds=1"))
    assert metrics.evaluation.split == "train"
    assert metrics.final.accuracy is None
    assert metrics.final.n == 72
    assert "has no labels for a test" in caplog.text
    assert metrics.rounds[0].with_target_labels is not None  # they judge pseudo-labels alone


def boxes(*sizes: float, scale: str = "metres", lowest: float = 0.0) -> Clouds:
    """A cube of each edge length, in metres, that stands at `lowest` above the floor."""
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), -1).reshape(-1, 3)
    stored = np.array([corners * size + (0, 0, lowest) for size in sizes], dtype=np.float32)
    names = tuple(f"scan{i}" for i in range(len(sizes)))
    return Clouds.of(stored, scale=scale, names=names)


FURNITURE = (0.3, 0.5, 0.5, 2.0)


def test_a_target_in_millimetres_is_refused():
    scans = boxes(300, 500, 0.5)
    with pytest.raises(DataError, match="own"):
        check_real_sizes("own", boxes(*FURNITURE), scans)
    check_real_sizes("own", boxes(*FURNITURE, scale="unit_ball"), scans)  # sizes do not matter
    with pytest.raises(DataError, match="own"):  # in any of its parts
        check_real_sizes("own", boxes(*FURNITURE), boxes(0.5), scans)
    with pytest.raises(DataError, match="own"):
        check_real_sizes("own", boxes(300, 500, 500, 2000), boxes(0.4, 0.6))


@pytest.mark.parametrize(("lowest", "warns"), [(-1.2, True), (-0.2, False)])
def test_a_floor_that_clouds_reach_through(lowest, warns, caplog: pytest.LogCaptureFixture):
    source = boxes(*FURNITURE, scale="above_floor")
    scans = boxes(0.4, 0.6, scale="above_floor", lowest=lowest)
    check_real_sizes("own", source, scans)
    assert bool(caplog.messages) == warns


def test_a_training_finds_it_before_it_trains(toy, toy_data: Path, tmp_path: Path):
    old = open_pointset(toy_data / "kinectsim10")
    rows = [
        ManifestRow(id=id_, cls=old.classes[label], split=split)
        for id_, label, split in zip(old.ids, old.labels, old.splits, strict=True)
    ]
    write_pointset(
        tmp_path / "kinectsim10",
        name="kinectsim10",
        classes=old.classes,
        arrays={"points": np.array(old.points) * 1000},
        rows=rows,
        meta={},
    )
    metres = ("data.source.unit=metres", "data.target.unit=metres", "data.scale=metres")
    with pytest.raises(DataError, match="kinectsim10"):
        train(toy(*metres, f"data.target.path={tmp_path / 'kinectsim10'}"))
