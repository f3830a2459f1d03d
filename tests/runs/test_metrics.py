"""The schema of `metrics.json`: what is written is read, and nothing else is taken for a result."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from qs3.config import hashing
from qs3.errors import DataError
from qs3.report.run_files import read_run
from qs3.report.tables.aggregate import load_run, summarise
from qs3.report.tables.formats import markdown
from qs3.report.tables.table import build_table
from qs3.runs.metrics import (
    METRICS,
    AccuracyEstimates,
    EpochScores,
    Estimates,
    Evaluated,
    PseudoLabelScores,
    RoundRecord,
    RunMetrics,
    StudentChoice,
    TrainingAccuracy,
    Trust,
    Warmup,
    read_metrics,
    write_metrics,
)
from qs3.training.command import train
from tests.report.made_runs import metrics, scores
from tests.report.tables.test_tables import run_cell
from tests.running import main
from tests.training.conftest import toy, toy_data  # noqa: F401 (fixtures)


def whole() -> RunMetrics:
    """A result that has everything: no figure is None."""
    judged = scores(
        0.75,
        per_class_recall={"a": 0.5, "b": 1.0},
        confusion=[[50, 50], [0, 100]],
        calibration_error=0.125,
    )
    last = EpochScores(epoch=9, scores=judged)
    shares = dict.fromkeys(("mean_confidence", "calibrated", "thresholded", "difference"), 0.25)
    teacher = Estimates(validation_accuracy=0.5, temperature=2.0, **shares)
    return metrics(
        final=judged,
        evaluation=Evaluated(
            split="test", labels=True, rotations=12, norms="adabn",
            prior_shares={"a": 0.4, "b": 0.6}, final_over_rotations=judged,
            warmup_over_rotations=judged, tiers={"hard": judged},
        ),
        warmup=Warmup(selected=last, last=last),
        rounds=[
            RoundRecord(
                round=0, theta=0.5, confident={"a": 3, "b": 2}, selected={"a": 2, "b": 1},
                mu={"a": 0.25, "b": 0.75}, thresholds={"a": 0.5, "b": 0.625}, total_confident=5,
                total_selected=3, missing_classes=["c"], agreement=0.5,
                with_target_labels=PseudoLabelScores(precision=0.5, recall=0.25, accuracy=0.75),
            )
        ],
        student=StudentChoice(
            rule="snd", epoch=7, score=1.5, scores={"7": 1.5, "8": 1.25}, held_out=0, last=last
        ),
        quality=AccuracyEstimates(
            validation_accuracy=0.9, temperature=1.5, **shares, clouds=200,
            validated_on="source_val", validation_clouds=40,
            rotation_agreement=0.5, teacher_agrees=0.5,
            teacher=teacher, unlike_source=0.1, never_predicted=["c"],
            trust=Trust(
                expected=0.6, trusted=True, held_out=0.8, shifts={"shapes": 0.5},
                lost={"shapes": 1.0}, error=0.1, error_90=0.2,
            ),
        ),
        training=TrainingAccuracy(n=12, accuracy=1.0),
    )  # fmt: skip


def places(node: Any, *path: str | int) -> Iterator[tuple[str | int, ...]]:
    """Where each value of a document is, from the outermost in."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield *path, key
        if isinstance(value, dict | list):
            yield from places(value, *path, key)


def at(document: Any, path: tuple[str | int, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


def refusal(folder: Path, text: str) -> str:
    """Where the file is wrong, and how, in the words of its refusal."""
    (folder / METRICS).write_text(text)
    with pytest.raises(DataError) as error:
        read_metrics(folder)
    said = re.fullmatch(
        rf"{re.escape(str(folder / METRICS))} is damaged: (.*); delete it and repeat the run's "
        "command, which trains nothing again",
        str(error.value),
    )
    assert said is not None, error.value
    return said[1]


def test_two_domains_of_one_name_are_two():
    """Own clouds of two folders, both called so: neither stands for the other."""
    own = replace(metrics(), source="own", target="own")
    assert own.seen["source"] == own.data.source
    made = replace(own.made_of, source=replace(own.made_of.source, objects="others"))
    assert [*replace(own, made_of=made).domains] == ["own (source)", "own (target)"]
    taught = replace(own, method="supervised", made_of=made)
    assert taught.seen["source"] == taught.data.target
    assert [*taught.domains] == ["own"]


@pytest.fixture
def document(tmp_path) -> dict[str, Any]:
    """The file of a result that has everything."""
    write_metrics(tmp_path, whole())
    return json.loads((tmp_path / METRICS).read_text())


@pytest.mark.parametrize("made", [whole(), metrics(), metrics(accuracy=None)])
def test_what_is_written_is_read(made, tmp_path):
    assert read_metrics(tmp_path) is None
    write_metrics(tmp_path, made)
    first = (tmp_path / METRICS).read_bytes()
    found = read_metrics(tmp_path)
    assert found == made
    write_metrics(tmp_path, found)
    assert (tmp_path / METRICS).read_bytes() == first
    assert [path.name for path in tmp_path.iterdir()] == [METRICS]


def test_the_file_has_the_names_of_the_schema(document):
    assert all(at(document, place) not in (None, [], {}) for place in places(document))
    assert document["final"]["per_class_recall"] == {"a": 0.5, "b": 1.0}
    assert document["warmup"]["selected"]["scores"] == document["final"]
    assert document["rounds"][0]["with_target_labels"]["precision"] == 0.5
    assert document["student"]["last"]["epoch"] == 9
    assert document["quality"]["teacher"]["temperature"] == 2.0
    assert document["status"] == "finished"


def test_an_unknown_key_is_named_wherever_it_is(document, tmp_path):
    objects = [(), *(p for p in places(document) if isinstance(at(document, p), dict))]
    assert len(objects) > 25
    of_any_name = {"predicted", "per_class_recall", "confident", "selected", "mu", "thresholds"}
    of_any_name |= {
        "prior_shares",
        "versions",
        "validators",
        "shifts",
        "lost",
    }  # of classes, packages, scores
    for place in objects:
        if place and place != ("warmup", "selected") and place[-1] in of_any_name:
            continue
        if place == ("student", "scores"):
            continue
        changed = copy.deepcopy(document)
        at(changed, place)["speed"] = 1.0
        said = refusal(tmp_path, json.dumps(changed))
        assert said.startswith(".".join(map(str, (*place, "speed"))) + ": "), said


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("seed",), "1"),
        (("seed",), 1.5),
        (("simulated",), 0),
        (("status",), "failed"),
        (("rounds", 0, "theta"), float("nan")),
        (("quality", "teacher", "calibrated"), float("inf")),
        (("final", "confusion", 0, 1), "text"),
    ],
)
def test_a_value_that_does_not_fit_is_named(document, tmp_path, place, value):
    at(document, place[:-1])[place[-1]] = value
    said = refusal(tmp_path, json.dumps(document))
    assert said.startswith(".".join(map(str, place)) + ": "), said


@pytest.mark.parametrize("place", [("hash",), ("final", "n"), ("rounds", 0, "theta")])
def test_a_missing_key_is_named(document, tmp_path, place):
    del at(document, place[:-1])[place[-1]]
    said = refusal(tmp_path, json.dumps(document))
    assert said.startswith(".".join(map(str, place)) + ": "), said


DAMAGED = {
    "empty": b"",
    "cut": b'{"experiment": "exp", "ha',
    "no object": b"[]",
    "null": b"null",
    "no key": b"{}",
    "no text": b"\xff\xfe{}",
    "deep": b"[" * 100_000,
}


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_file_is_named(how, tmp_path):
    (tmp_path / METRICS).write_bytes(DAMAGED[how])
    with pytest.raises(DataError, match=r"metrics\.json is damaged: .*; delete it and repeat"):
        read_metrics(tmp_path)


def test_every_reader_names_a_damaged_file(toy, tmp_path, capsys):  # noqa: F811
    cell = build_table("quickstart", tmp_path / "logs").cells[0]
    run_cell(tmp_path / "logs", cell, seeds=(0,))
    (file,) = (tmp_path / "logs").rglob(METRICS)
    file.write_bytes(DAMAGED["cut"])
    said = rf"{re.escape(str(file))} is damaged: .*; delete it and repeat"
    with pytest.raises(DataError, match=said):
        read_run(file.parent)
    assert main(["report", "page", f"run={file.parent}"]) == 1
    assert re.search(said, capsys.readouterr().err)
    found = load_run(file.parent)
    assert (found.status, found.metrics) == ("damaged", None)
    assert re.search(said, found.problem)
    assert re.search(said, summarise([file.parent]))
    table = build_table("quickstart", tmp_path / "logs")
    assert re.search(said, markdown(table))
    assert table.cells[0].ours("accuracy") is None

    cfg = toy("selftraining=none")
    own = hashing.run_folder(cfg)
    own.mkdir(parents=True)
    (own / METRICS).write_bytes(DAMAGED["cut"])
    with pytest.raises(DataError, match=rf"{re.escape(str(own / METRICS))} is damaged: "):
        train(cfg)
    assert (own / METRICS).read_bytes() == DAMAGED["cut"]


def test_a_file_that_cannot_be_read(tmp_path):
    (tmp_path / METRICS).mkdir()
    with pytest.raises(DataError, match=r"metrics\.json cannot be read .*; delete it and repeat"):
        read_metrics(tmp_path)
