"""Which epoch of the last round is reported: each rule in whole runs, and what it may not do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from qs3.config.hydra import build, run_folder
from qs3.datamodules.clouds import load_clouds
from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.errors import SelectionError
from qs3.evaluation.metrics import predict
from qs3.evaluation.validators import LABEL_FREE
from qs3.runs.checkpoints import copy_weights, load
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.runs.predictions import read_pseudo_labels
from qs3.selftraining.student_selection import StudentSelection
from qs3.store.store import open_pointset
from qs3.training.command import headline, train
from tests.training.conftest import result_of
from tests.training.toy import CLASSES, toy_config

LOOKING = ("entropy", "infomax")  # the least and the greatest; snd is like infomax
LAST_ROUND = range(5, 7)  # epochs; 0 to 2 are the warm-up, 3 and 4 round 0
WEIGHTS = ("warmup_selected.pt", "warmup_last.pt", "student.pt")

Trained = Callable[[str], Path]


@pytest.fixture(scope="module")
def by_rule(toy_data: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Folder of the toy run with a rule, trained when first asked for; see also `epoch_file`."""
    folders = {"last": finished}

    def trained(rule: str) -> Path:
        if rule not in folders:
            root = tmp_path_factory.mktemp(rule)
            cfg = toy_config(root, f"paths.data_dir={toy_data}", f"selection.student={rule}")
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(StudentSelection, "_score", keep_and_score)
                if rule == "pseudo_val":
                    patch.setattr(Classifier, "training_step", keep_and_train)
                train(cfg)
            folders[rule] = run_folder(cfg)
        return folders[rule]

    return trained


def epoch_file(run: Path, epoch: int) -> Path:
    """Weights of an epoch of the last round, of a run of `by_rule`."""
    return run.parent / f"epoch_{epoch}.pt"


def keep_and_score(self, net, data, classifier, score=StudentSelection._score):
    torch.save(copy_weights(net), epoch_file(self.folder, classifier.current_epoch))
    return score(self, net, data, classifier)


sets: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}  # of pseudo_val, by epoch
selection: list[StudentSelection] = []


def keep_and_train(self, batch, batch_idx, real=Classifier.training_step):
    data = self.trainer.datamodule
    if data.pseudo is not None:
        sets[self.current_epoch] = data.pseudo
        assert len(self.trainer.train_dataloader.parts["target"]) == len(data.pseudo[0])
    selection[:] = [c for c in self.trainer.callbacks if isinstance(c, StudentSelection)]
    return real(self, batch, batch_idx)


def metrics_of(folder: Path) -> RunMetrics:
    metrics = read_metrics(folder)
    assert metrics is not None
    return metrics


def weights_of(file: Path) -> dict[str, torch.Tensor]:
    found = load(file)
    return found["weights"] if file.name == "result.pt" else found


def same_weights(one: Path, other: Path) -> bool:
    a, b = weights_of(one), weights_of(other)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def table_of(cfg: Any, weights: Path, data: Path, rows: Any = slice(None)) -> np.ndarray:
    """What weights say of the target's training clouds, or of some of them."""
    net = build(cfg.model)
    net.load_state_dict(load(weights))
    points = load_clouds(open_pointset(data / "kinectsim10"), "train", 32, scale="unit_ball").points
    return predict(net, points[rows], 64)


@pytest.mark.parametrize("rule", LOOKING)
def test_a_rule_without_held_out_clouds_only_looks(by_rule, finished, rule):
    ours, theirs = result_of(by_rule(rule)), result_of(finished)
    ours, theirs = ({k: v for k, v in r.items() if k != "metrics"} for r in (ours, theirs))
    assert ours == theirs  # history and pseudo-labels
    for name in WEIGHTS:
        assert same_weights(by_rule(rule) / name, finished / name), name


@pytest.mark.parametrize("rule", [*LOOKING, "pseudo_val"])
def test_metrics_name_rule_epoch_and_score(by_rule, finished, rule):
    metrics = metrics_of(by_rule(rule))
    student = metrics.student
    assert list(student.scores) == [str(epoch) for epoch in LAST_ROUND]
    scores = {int(epoch): score for epoch, score in student.scores.items()}
    best = (min if rule == "entropy" else max)(scores.values())
    assert student.score == best
    assert student.epoch == min(epoch for epoch in scores if scores[epoch] == best)
    said = f"{rule}, epoch {student.epoch}, score {best:.6g}"
    assert metrics.selection.student == said
    assert headline(metrics).endswith(
        f"; student by {rule}, epoch {student.epoch + 1}, score {best:.6g}"
    )
    assert student.rule == rule
    assert student.last.epoch == 6
    if rule != "pseudo_val":  # there the last round was trained on fewer clouds
        assert student.last.scores == metrics_of(finished).final


@pytest.mark.parametrize("rule", LOOKING)
def test_scores_are_those_of_each_epoch_on_the_targets_training_clouds(
    by_rule, toy, toy_data, rule
):
    """Again from the weights of each epoch."""
    folder, cfg = by_rule(rule), toy()
    student = metrics_of(folder).student
    for epoch in LAST_ROUND:
        table = table_of(cfg, epoch_file(folder, epoch), toy_data)
        score = LABEL_FREE[rule].score(table)
        assert student.scores[str(epoch)] == pytest.approx(score, abs=1e-6)
    chosen = folder / "student_selected.pt"
    assert same_weights(chosen, epoch_file(folder, student.epoch))
    assert same_weights(folder / "result.pt", chosen)


def test_held_out_clouds_are_not_trained_on(by_rule):
    folder = by_rule("pseudo_val")
    metrics = metrics_of(folder)
    held, held_labels = selection[0].held_out
    rows = [*read_pseudo_labels(folder / "round_01" / "pseudo_labels.csv").itertuples()]
    selected = [i for i, row in enumerate(rows) if row.selected]
    for epoch in LAST_ROUND:
        index, labels = sets[epoch]
        assert sorted([*index.tolist(), *held.tolist()]) == selected
        both = [*zip(index.tolist(), labels.tolist(), strict=True)]
        both += zip(held.tolist(), held_labels.tolist(), strict=True)
        assert all(CLASSES[label] == rows[i].label for i, label in both)
    assert len(sets[3][0]) == metrics.rounds[0].total_selected  # round 0 holds nothing out
    assert metrics.student.held_out == len(held)
    assert metrics.rounds[1].total_selected == len(selected)
    assert len(held) == pytest.approx(len(selected) / 5, abs=1.5)


def test_a_label_of_no_weight_is_not_held_out(tmp_path):
    """It names no class: all of it being 0, its first place is not its most probable one."""
    callback = StudentSelection(tmp_path, Phases(1, 1, 1), "pseudo_val")
    soft = torch.zeros(40, 3)
    soft[:20] = torch.eye(3)[torch.arange(20) % 2 + 1]  # rods and slabs, no ball
    data = SimpleNamespace(
        pseudo=(torch.arange(40), soft),
        seed=0,
        target=SimpleNamespace(ids=[str(i) for i in range(40)]),
    )
    callback._hold_out(data)
    index, labels = callback.held_out
    assert len(index) >= 2
    assert (index < 20).all()
    assert torch.equal(labels, index % 2 + 1)
    assert sorted([*index.tolist(), *data.pseudo[0].tolist()]) == list(range(40))


def test_each_process_has_two_to_train_on(tmp_path):
    """Of five of a class one is held out: four are too few for four processes, not for three."""
    pseudo = (torch.arange(5), torch.zeros(5, dtype=torch.int64))
    data = SimpleNamespace(
        pseudo=pseudo,
        seed=0,
        target=SimpleNamespace(ids=[str(i) for i in range(5)]),
    )
    callback = StudentSelection(tmp_path, Phases(1, 1, 1), "pseudo_val")
    callback._hold_out(data, processes=3)
    assert len(callback.held_out[0]) == 1
    data.pseudo = pseudo
    with pytest.raises(SelectionError, match="pseudo_val"):
        callback._hold_out(data, processes=4)
