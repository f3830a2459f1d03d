"""`weights`: a run begins with a trained classifier, which may be its first teacher as it is."""

from dataclasses import replace

import pytest
import torch

from qs3.config.hydra import run_folder
from qs3.errors import ConfigError, DataError
from qs3.inference.model_file import read_result, write_result
from qs3.runs.checkpoints import load
from qs3.runs.metrics import read_metrics
from qs3.training.command import train
from tests.training.watching import interrupt

ONLY_ROUNDS = ("selection.teacher=given", "protocol.epochs=1", "selftraining.init=continue")


def test_the_teacher_is_what_was_given(toy, finished):
    cfg = toy(*ONLY_ROUNDS, f"weights={finished}")
    metrics = train(cfg)
    folder, before = run_folder(cfg), read_metrics(finished)
    given, kept = read_result(finished).weights, load(folder / "warmup_selected.pt")
    assert all(torch.equal(value, kept[name]) for name, value in given.items())
    assert metrics.warmup.selected.epoch == -1
    assert metrics.warmup.selected.scores == before.final
    assert metrics.selection.teacher == f"given, {finished.name}"
    assert metrics.versions["weights"].startswith(f"{finished.name} ")
    last = load(folder / "warmup_last.pt")  # an epoch was trained, and counts for nothing
    assert any(not torch.equal(value, last[name]) for name, value in given.items())
    assert len(metrics.rounds) == 2


def test_another_classifier_under_its_name_is_refused(toy, finished, tmp_path):
    teacher = tmp_path / "teacher.pt"
    result = read_result(finished)
    write_result(teacher, result)
    cfg = toy(*ONLY_ROUNDS, "selftraining.rounds=1", f"weights={teacher}")
    before = train(cfg)
    assert train(cfg).final == before.final  # it is there, and the same
    changed = {name: value + 1 for name, value in result.weights.items()}
    write_result(teacher, replace(result, weights=changed))
    with pytest.raises(DataError, match=r"classifier teacher\.pt"):
        train(cfg)
    teacher.unlink()
    assert train(cfg).final == before.final  # put away: the result stands


def test_a_run_does_not_go_on_with_another_classifier(toy, finished, tmp_path):
    teacher = tmp_path / "teacher.pt"
    result = read_result(finished)
    write_result(teacher, result)
    cfg = toy("selftraining=none", "protocol.epochs=3", f"weights={teacher}")
    interrupt(cfg, epoch=1)
    changed = {name: value + 1 for name, value in result.weights.items()}
    write_result(teacher, replace(result, weights=changed))
    with pytest.raises(DataError, match="weights="):
        train(cfg)


@pytest.mark.parametrize(
    ("change", "words", "error", "message"),
    [
        ({}, ("data.scale=metres", "data.source.unit=metres"), ConfigError, "data.scale"),
        ({"classes": ("rod", "ball", "slab")}, (), DataError, "rod, ball, slab"),
        ({"model": {"_target_": "tests.x.Y", "num_classes": 3}}, (), ConfigError, "tests.x.Y"),
        ({"more": 5}, (), ConfigError, "model.more=5"),
    ],
)
def test_what_does_not_fit_is_told(toy, finished, tmp_path, change, words, error, message):
    result = read_result(finished)
    if more := change.pop("more", None):
        change = {"model": {**result.model, "more": more}}
    write_result(tmp_path / "result.pt", replace(result, **change))
    with pytest.raises(error, match=message):
        train(toy(*words, f"weights={tmp_path / 'result.pt'}"))
