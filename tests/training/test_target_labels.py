"""Training cannot reach the target's labels: everything that hangs on it is searched for them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qs3.datamodules.splits import lineage
from qs3.engine.classifier import Classifier
from qs3.evaluation.metrics import Evaluation
from qs3.store.meta import ManifestRow
from qs3.store.store import PointSet, open_pointset, write_pointset
from qs3.training.command import train
from tests.training.search import Truth, search
from tests.training.toy import _SHAPES, CLASSES, write_domain

TRAIN, TEST = 90, 45


def write_shuffled_target(folder: Path, class_in_id: bool) -> None:
    """Classes in a random order: nothing else in memory has it."""
    rng = np.random.default_rng(7)
    clouds, rows = [], []
    for split, count in (("train", TRAIN), ("test", TEST)):
        for i, label in enumerate(rng.integers(3, size=count)):
            cls = CLASSES[label]
            clouds.append(rng.normal(size=(64, 3)) * _SHAPES[cls] + 0.5 * rng.normal(size=(64, 3)))
            name = f"{cls}/{split}/{i:03d}" if class_in_id else f"scan/{split}/{i:03d}"
            rows.append(ManifestRow(id=name, cls=cls, split=split))
    write_pointset(
        folder / "kinectsim10",
        name="kinectsim10",
        classes=CLASSES,
        arrays={"points": np.array(clouds, dtype=np.float32)},
        rows=rows,
        meta={},
    )


def truth_of(folder: Path) -> Truth:
    """The target's labels of both splits, as stored, by id, and as validation divides them."""
    target = open_pointset(folder / "kinectsim10")
    wanted = {}
    for split in ("train", "test"):
        part = target.split(split)
        by_id = np.argsort(np.array(part.ids), kind="stable")
        wanted |= {f"{split} labels": part.labels, f"{split} labels by id": part.labels[by_id]}
        for side, rows in zip(("t", "v"), lineage(part.ids), strict=True):
            wanted[f"{split} labels, lineage {side}"] = part.labels[rows]
    return Truth(wanted, kinds=(PointSet, Evaluation))


class Watch:
    """Searches as each phase begins, from within `training_step`; and for what is planted there."""

    def __init__(self) -> None:
        self.found: set[str] = set()
        self.planted: list[bool] = []
        self.keys: set[str] = set()
        self.truth: Truth | None = None
        self.plant: Callable[[Any], None] | None = None

    def look(self, classifier: Classifier, batch: dict[str, Any], batch_idx: int) -> None:
        self.keys.update(key for part in batch.values() if isinstance(part, dict) for key in part)
        if batch_idx or not classifier.phases.starts(classifier.current_epoch):
            return
        assert self.truth is not None
        trainer = classifier.trainer
        roots = {
            "trainer": trainer,
            "classifier": classifier,
            "datamodule": trainer.datamodule,
            "callbacks": trainer.callbacks,
            "loader": trainer.train_dataloader,
            "batch": batch,
            "modules": {name: vars(m) for name, m in sys.modules.items() if name.startswith("qs3")},
        }
        self.found.update(search(roots, self.truth))
        if classifier.current_epoch == 0:
            trainer.datamodule.target.__dict__["planted"] = self.truth.wanted["test labels"].copy()
            self.planted.append(bool(search({"trainer": trainer}, self.truth)))
            del trainer.datamodule.target.__dict__["planted"]


@pytest.fixture
def watch(monkeypatch):
    """Searches while `train` runs."""
    watching = Watch()
    real = Classifier.training_step

    def step(self, batch, batch_idx):
        _LOOK[0](self, batch, batch_idx)
        return real(self, batch, batch_idx)

    _LOOK[0] = watching.look
    monkeypatch.setattr(Classifier, "training_step", step)
    yield watching
    _LOOK[0] = None


_LOOK: list[Any] = [None]  # a global, so that the search does not find what it searches for


CASES = [
    (("method=source_only", "selftraining=none"), False),
    (("selftraining.use_source=true",), True),
    ((), False),
]


@pytest.mark.parametrize(("settings", "class_in_id"), CASES)
def test_no_target_label_within_reach(toy, tmp_path, watch, settings, class_in_id):
    write_domain(tmp_path / "data", "specklenet10", noise=0.05)
    write_shuffled_target(tmp_path / "data", class_in_id)
    watch.truth = truth_of(tmp_path / "data")
    rounds = "selftraining=none" not in settings
    short = ["protocol.epochs=2", *["selftraining.epochs=1"] * rounds]
    metrics = train(toy(f"paths.data_dir={tmp_path / 'data'}", *short, *settings))
    assert metrics.final.accuracy < 1  # else pseudo-labels would be the labels
    assert watch.planted == [True]
    # What a cloud is called may tell its class. No batch and no loss holds a name.
    names = {path for path in watch.found if path.endswith("names: train labels")}
    assert watch.found == names
    assert bool(names) == class_in_id
    more = {"y_pseudo"} if rounds else set()
    assert watch.keys == {"points", "y_source"} | more


@pytest.mark.slow
def test_the_upper_bound_does_hold_them(toy, tmp_path, watch):
    """The same search finds what `method=supervised` asks for: the training labels alone."""
    write_domain(tmp_path / "data", "specklenet10", noise=0.05)
    write_shuffled_target(tmp_path / "data", class_in_id=False)
    watch.truth = truth_of(tmp_path / "data")
    train(toy(f"paths.data_dir={tmp_path / 'data'}", "method=supervised", "selftraining=none"))
    which = {path.split(": ")[-1] for path in watch.found}
    assert which == {"train labels, lineage t", "train labels, lineage v"}
    assert watch.keys == {"points", "y_target_train"}
