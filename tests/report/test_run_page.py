"""A run's pictures and page show what its files hold; what is missing or damaged is named."""

import base64
import csv
import logging
import os
import re
import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from qs3.config.hydra import config_sha256, run_folder
from qs3.errors import DataError, MissingDataError
from qs3.report import run_page
from qs3.report.run_page import AfterTraining, draw, read_run
from qs3.runs.metrics import DataHashes, Scores, read_metrics
from qs3.runs.predictions import read_predictions, write_predictions
from qs3.training.command import train
from tests.report.made_runs import change, not_blank, table
from tests.report.pages import data_of
from tests.running import main
from tests.training.toy import CLASSES

ALL = ["curves"]
NO_EPOCH = "epoch,phase,lr\n"  # of a history: nothing is drawn, which takes a while


def texts(ax):
    return [text.get_text() for text in ax.texts]


def line(ax, label):
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return np.array(found.get_xdata()), np.array(found.get_ydata())


def test_files_and_page(run, tmp_path):
    drawn = draw(run)
    assert list(drawn.pictures) == ALL
    assert drawn.skipped == {}
    for name, path in drawn.pictures.items():
        assert path == run / "pictures" / f"{name}.png"
        assert not_blank(path), name
    again = draw(run, tmp_path / "elsewhere")
    for name, path in again.pictures.items():
        assert path.read_bytes() == drawn.pictures[name].read_bytes(), name
    page = drawn.page.read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    images = re.findall(r"base64,([A-Za-z0-9+/=]+)\"", page)
    assert [base64.b64decode(i) for i in images] == [
        path.read_bytes() for path in drawn.pictures.values()
    ]
    metrics = read_metrics(run)
    for words in (
        f"<td>{metrics.final.accuracy:.1%}</td>",
        "kinectsim10 (simulated)",
        "python train.py experiment=quickstart",
        "  epochs: 3",
        f"source_val, epoch {metrics.warmup.selected.epoch + 1}<",
    ):
        assert words in page
    shown = data_of(page)["clouds"]
    wrong = [cloud["label"] != cloud["called"] for cloud in shown]
    assert wrong == sorted(wrong, reverse=True)
    assert len(shown) == 24


def test_curves_are_the_history(run):
    rows, axes = (
        table(run / "history.csv"),
        run_page._curves(read_run(run), read_run(run).history).axes,
    )
    loss, accuracy = line(axes[0], "train/loss"), line(axes[1], "source_val/acc")
    from_1 = [int(row["epoch"]) + 1 for row in rows]
    np.testing.assert_allclose(loss, [from_1, [float(row["train/loss"]) for row in rows]])
    np.testing.assert_allclose(accuracy[1], [100 * float(r["source_val/acc"]) for r in rows])
    np.testing.assert_allclose(line(axes[2], "lr")[1], [float(row["lr"]) for row in rows])
    assert texts(axes[0]) == ["warm-up", "0", "1"]
    assert [p.get_x() for p in axes[0].patches] == [0.5, 5.5]  # warm-up and every other round
    teacher = read_metrics(run).warmup.selected.epoch
    assert line(axes[0], f"teacher: epoch {teacher + 1}")[0].tolist() == [teacher + 1] * 2


def test_pseudo_labels_are_those_of_the_tables(run):
    records = read_metrics(run).rounds
    shown = run_page.pseudo_labels(records, CLASSES)
    for r, record in enumerate(records):
        rows = table(run / f"round_{r:02d}" / "pseudo_labels.csv")
        kept = Counter(row["label"] for row in rows if row["selected"] == "1")
        column = shown[f"round {r}"]
        for name in CLASSES:
            want = f"{kept[name]}/{record.confident[name]}, mu {record.mu[name]:.2f}"
            assert column[name] == want
        assert column["theta"] == record.theta
        judged = record.with_target_labels
        for key in ("precision", "recall"):
            assert column[f"{key} (evaluation only)"] == getattr(judged, key)


def test_a_net_that_has_diverged_has_a_page_that_browsers_read(run):
    """JSON.parse takes no NaN: the page would stay without its clouds."""
    p = read_predictions(run / "predictions.csv")
    lost = replace(p, probabilities=np.full_like(p.probabilities, np.nan))
    write_predictions(run / "predictions.csv", lost)
    (run / "history.csv").write_text(NO_EPOCH)
    page = draw(run).page.read_text()
    assert {one["sure"] for one in data_of(page)["clouds"]} == {None}


def test_unlabelled_target(run):
    metrics = read_metrics(run)
    final = Scores(n=metrics.final.n, predicted=metrics.final.predicted)
    rounds = [replace(record, with_target_labels=None) for record in metrics.rounds]
    change(run, final=final, rounds=rounds)
    (run / "history.csv").write_text(NO_EPOCH)
    rows = table(run / "predictions.csv")
    with open(run / "predictions.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows({**row, "label": ""} for row in rows)
    page = draw(run).page.read_text()
    assert "in doubt first" in page
    assert "is \\ called" not in page
    assert "recall (evaluation only)" not in page


def test_unfinished_run(run):
    (run / "metrics.json").unlink()
    (run / "predictions.csv").unlink()
    drawn = draw(run)
    assert list(drawn.pictures) == ["curves"]
    assert "not finished" in drawn.page.read_text()
    (run / "history.csv").write_text(NO_EPOCH)
    assert "no epoch" in draw(run).skipped["curves"]
    with pytest.raises(MissingDataError):
        draw(run.parent)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("history.csv", ""),
        ("predictions.csv", "id,mesh\n"),
        ("metrics.json", "{"),
        (".hydra/config.yaml", "a: [1"),
    ],
)
def test_damaged_files_are_named(run, name, text):
    (run / name).write_text(text)
    with pytest.raises(DataError, match=re.escape(name.split("/")[0])):
        draw(run)


def test_command(run, toy_data, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["report", "page", f"run={run}", f"data_dir={toy_data}", f"out={out}"]) == 0
    shown = [str(out / name) for name in ("curves.png", "index.html")]
    assert capsys.readouterr().out.splitlines() == shown


def test_missing_or_damaged_data_cost_their_pictures_and_not_the_page(run, toy_data, tmp_path):
    (run / "history.csv").write_text(NO_EPOCH)
    data_dir = tmp_path / "copy"
    shutil.copytree(toy_data, data_dir)
    (data_dir / "kinectsim10" / "points.npy").write_bytes(b"no array")
    drawn = draw(run, data_dir=data_dir)
    assert {*drawn.skipped} == {"curves", "clouds"}
    assert "<li>clouds: " in drawn.page.read_text()
    assert "is not at" in draw(run, data_dir=tmp_path).skipped["clouds"]
    change(run, data=DataHashes(source="0" * 64, target="0" * 64))
    assert "is not the kinectsim10" in draw(run).skipped["clouds"]


def test_training_draws_and_its_hash_does_not_know(toy):
    words = ("selftraining=none", "protocol.epochs=1")
    cfg = toy("report.pictures=true", *words)
    assert config_sha256(cfg) == config_sha256(toy(*words))
    train(cfg)
    pictures = run_folder(cfg) / "pictures"
    assert {p.name for p in pictures.iterdir()} == {
        *(f"{name}.png" for name in ALL), "index.html",
    }  # fmt: skip


def test_a_failed_picture_is_a_warning(run, caplog):
    (run / "pictures").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        AfterTraining()(run)
    assert "the run is finished, but its pictures failed" in caplog.text


@pytest.mark.slow
def test_offline_wandb_gets_curves(toy, monkeypatch):
    from wandb.sdk.wandb_run import Run

    rows, log = [], Run.log
    monkeypatch.setattr(Run, "log", lambda run, row, *a: rows.append(row) or log(run, row, *a))
    cfg = toy("logger=wandb")
    train(cfg)
    folder = run_folder(cfg)
    history = table(folder / "history.csv")
    losses = [row["train/loss"] for row in rows if "train/loss" in row]
    assert losses == pytest.approx([float(row["train/loss"]) for row in history])
    # The warm-up comes from that run: its epochs are in this one's log, too.
    rows.clear()
    train(toy("logger=wandb", "selftraining.theta=0.3"))
    assert [row["trainer/global_step"] for row in rows] == [*range(len(history))]
    assert "WANDB_MODE" not in os.environ  # nor in the next job of a multirun
