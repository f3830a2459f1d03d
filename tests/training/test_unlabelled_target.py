"""Targets that cannot judge: somebody's own scans without labels, or without a test split."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qs3.config import hashing
from qs3.runs.metrics import read_metrics
from qs3.store.meta import ManifestRow
from qs3.store.store import PointSet, open_pointset, write_pointset
from qs3.training.command import headline, train
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


@pytest.mark.parametrize("more", [("selftraining=none",), ("evaluation.rotations=2",)])
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
        turned = metrics.evaluation
        assert turned.rotations == 2
        for scores in (turned.final_over_rotations, turned.warmup_over_rotations):
            assert (scores.n, scores.accuracy) == (final.n, None)
    assert "no labels to judge kinectsim10 (simulated) by; predicted " in headline(metrics)
    assert train(cfg) == metrics == read_metrics(hashing.run_folder(cfg))


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
