"""Pictures of a run show what its files hold; what is missing or damaged is named."""

import base64
import csv
import json
import logging
import os
import re
import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.config import hashing
from qs3.errors import DataError, MissingDataError
from qs3.evaluation.calibration import calibration_error, reliability
from qs3.inference.model_file import Result, write_result
from qs3.models.pointnet import pointnet
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.runs import figures as run_figures
from qs3.report.runs.data import read_run
from qs3.report.runs.pictures import AfterTraining, draw
from qs3.runs.checkpoints import save
from qs3.runs.metrics import DataHashes, EpochScores, Scores, StudentChoice, read_metrics
from qs3.runs.predictions import read_predictions, write_predictions
from qs3.training.command import train
from tests.report.made_runs import change, not_blank, table
from tests.report.wandb_files import read
from tests.running import main
from tests.training.toy import CLASSES
from tests.utils.test_yamls import laughs

ALL = [
    *("curves", "confusion", "pseudo_labels", "classes", "calibration"),
    *("domains", "source_clouds", "target_clouds", "class_balance", "mistakes"),
]


def texts(ax):
    return [text.get_text() for text in ax.texts]


def line(ax, label):
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return np.array(found.get_xdata()), np.array(found.get_ydata())


def heights(ax, label):
    (bars,) = [each for each in ax.containers if each.get_label() == label]
    return [bar.get_height() for bar in bars]


def test_files_and_page(run, tmp_path):
    drawn = draw(run, embed=False)
    assert list(drawn.pictures) == ALL
    assert drawn.skipped == {}
    assert drawn.notes == ()
    assert drawn.page == run / "pictures" / "index.html"
    for name, path in drawn.pictures.items():
        assert path == run / "pictures" / f"{name}.png"
        assert not_blank(path), name
    again = draw(run, tmp_path / "elsewhere", embed=False)
    for name, path in again.pictures.items():
        assert path.read_bytes() == drawn.pictures[name].read_bytes(), name
    check_page(run, drawn)


def check_page(run, drawn):
    """It needs no other file, links one, and says what the run was and is."""
    page = drawn.page.read_text()
    assert drawn.clouds == run / "pictures" / "clouds.html"
    assert page.count('<a href="clouds.html">') == 1
    page = page.replace('<a href="clouds.html">', "")
    assert not re.search(r'(src|href)="(?!data:)', page)
    images = re.findall(r"base64,([A-Za-z0-9+/=]+)", page)
    assert [base64.b64decode(i) for i in images] == [
        p.read_bytes() for p in drawn.pictures.values()
    ]
    metrics = read_metrics(run)
    assert f"<td>{metrics.final.accuracy:.1%}</td>" in page
    assert "kinectsim10 (simulated)" in page
    assert "python train.py experiment=quickstart" in page
    assert "  epochs: 4" in page
    chosen = read_metrics(run).warmup.selected.epoch
    assert f"source_val, epoch {chosen + 1}<" in page
    assert "<script" not in page


def test_curves_are_the_history(run):
    rows, axes = table(run / "history.csv"), run_figures.curves(read_run(run)).axes
    epochs = [int(row["epoch"]) for row in rows]
    loss, accuracy = line(axes[0], "train/loss"), line(axes[1], "source_val/acc")
    from_1 = [epoch + 1 for epoch in epochs]
    np.testing.assert_array_equal(loss, [from_1, [float(row["train/loss"]) for row in rows]])
    np.testing.assert_allclose(accuracy[1], [100 * float(r["source_val/acc"]) for r in rows])
    np.testing.assert_array_equal(line(axes[2], "lr")[1], [float(row["lr"]) for row in rows])
    assert texts(axes[0]) == ["warm-up", "round 0", "round 1"]
    assert [p.get_x() for p in axes[0].patches] == [0.5, 7.5]  # warm-up and every other round
    teacher = read_metrics(run).warmup.selected.epoch
    assert line(axes[0], f"teacher: epoch {teacher + 1}")[0].tolist() == [teacher + 1] * 2


def test_chosen_student_is_marked(run):
    last = EpochScores(epoch=9, scores=read_metrics(run).final)
    scores = {"7": 0.1, "8": 0.3, "9": 0.2}
    student = StudentChoice(rule="snd", epoch=8, score=0.3, scores=scores, held_out=0, last=last)
    change(run, student=student)
    axes = run_figures.curves(read_run(run)).axes
    assert line(axes[1], "student: epoch 9")[0].tolist() == [9, 9]


def test_confusion_is_that_of_the_predictions(run):
    figure = run_figures.confusion(read_run(run))
    rows = table(run / "predictions.csv")
    counts = Counter((row["label"], row["predicted"]) for row in rows)
    drawn = np.array(figure.axes[0].images[0].get_array())
    per_class = Counter(row["label"] for row in rows)
    for i, true in enumerate(CLASSES):
        for j, predicted in enumerate(CLASSES):
            assert drawn[i, j] == pytest.approx(counts[true, predicted] / per_class[true])
    words = [t.split("\n") for t in texts(figure.axes[0])]
    assert sorted(int(n) for n, _ in words) == sorted(counts.values())
    final, title = read_metrics(run).final, figure.get_suptitle()
    assert "kinectsim10 (simulated)" in title
    for key in ("accuracy", "balanced_accuracy", "majority_rate"):
        assert f"{getattr(final, key):.1%}" in title
    change(run, simulated=False)
    assert "simulated" not in run_figures.confusion(read_run(run)).get_suptitle()


def test_pseudo_labels_are_those_of_the_tables(run):
    axes = run_figures.pseudo_labels(read_run(run)).axes
    records = read_metrics(run).rounds
    for r, record in enumerate(records):
        rows = table(run / f"round_{r:02d}" / "pseudo_labels.csv")
        kept = Counter(row["label"] for row in rows if row["selected"] == "1")
        for k, name in enumerate(CLASSES):
            assert np.array(axes[0].images[0].get_array())[k, r] == kept[name]
            assert f"{kept[name]}/{record.confident[name]}" in texts(axes[0])
            assert np.array(axes[1].images[0].get_array())[k, r] == record.mu[name]
        assert heights(axes[2], "selected")[r] == sum(kept.values())
        assert heights(axes[2], "confident")[r] == record.total_confident
    assert line(axes[2], "all target clouds")[1].tolist() == [72, 72]
    theta = line(axes[3], "theta, the confidence asked for")[1]
    assert theta.tolist() == [record.theta for record in records]
    for key in ("precision", "recall"):
        judged = line(axes[3], f"{key} (with target labels, evaluation only)")[1]
        assert judged.tolist() == [getattr(r.with_target_labels, key) for r in records]


def test_classes_are_counted(run):
    axes = run_figures.classes(read_run(run), np.repeat([0, 1, 2], [5, 6, 7])).axes
    rows = table(run / "predictions.csv")
    predicted = Counter(row["predicted"] for row in rows)
    assert heights(axes[1], "predicted by the result") == [predicted[name] for name in CLASSES]
    assert heights(axes[1], "true (with target labels, evaluation only)") == [8, 8, 8]
    assert heights(axes[0], "true (with target labels, evaluation only)") == [5, 6, 7]
    named = Counter(row["label"] for row in table(run / "round_01" / "pseudo_labels.csv"))
    assert heights(axes[0], "named by the teacher of round 1") == [named[name] for name in CLASSES]


def test_calibration_is_the_reported_error(run):
    p = read_predictions(run / "predictions.csv")
    found = reliability(p.probabilities, p.labels)
    assert found.error == pytest.approx(calibration_error(p.probabilities, p.labels))
    assert found.error == pytest.approx(read_metrics(run).final.calibration_error)
    axes = run_figures.calibration(read_run(run)).axes
    assert axes[1].containers[0].datavalues.sum() == 24
    assert heights(axes[0], "accuracy") == pytest.approx(found.accuracy[found.count > 0])


def test_a_net_that_has_diverged_has_no_calibration_and_a_page_that_browsers_read(run):
    """JSON.parse takes no NaN: the page of clouds would stay empty."""
    p = read_predictions(run / "predictions.csv")
    lost = replace(p, probabilities=np.full_like(p.probabilities, np.nan))
    write_predictions(run / "predictions.csv", lost)
    drawn = draw(run, embed=False)
    assert "diverged" in drawn.skipped["calibration"]
    assert "nan%" not in drawn.page.read_text()

    def refused(constant):
        raise AssertionError(constant)

    (text,) = re.findall(r'id="clouds">(.*?)</script>', drawn.clouds.read_text())
    data = json.loads(text, parse_constant=refused)
    assert {one["sure"] for one in data["clouds"]} == {None}


def test_predictions_of_a_cloud_that_the_data_lack_are_damaged(run):
    path = run / "predictions.csv"
    p = read_predictions(path)
    write_predictions(path, replace(p, ids=tuple(f"{id_}?" for id_ in p.ids)))
    drawn = draw(run, embed=False)
    for name in ("mistakes", "clouds"):
        assert f"{path} is damaged (no cloud is called" in drawn.skipped[name]
    assert "confusion" in drawn.pictures


def test_missing_round_folders(run):
    shutil.rmtree(run / "round_00")
    drawn = draw(run, embed=False)
    assert list(drawn.pictures) == ALL
    assert "round_00/pseudo_labels.csv is gone" in " ".join(drawn.notes)
    assert "round_00/pseudo_labels.csv is gone" in drawn.page.read_text()
    kept = read_metrics(run).rounds[0].selected
    axes = run_figures.pseudo_labels(read_run(run)).axes
    assert np.array(axes[0].images[0].get_array())[:, 0].tolist() == [kept[c] for c in CLASSES]


def test_unlabelled_target(run):
    metrics = read_metrics(run)
    final = Scores(n=metrics.final.n, predicted=metrics.final.predicted)
    rounds = [replace(record, with_target_labels=None) for record in metrics.rounds]
    change(run, final=final, rounds=rounds)
    rows = table(run / "predictions.csv")
    with open(run / "predictions.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows({**row, "label": ""} for row in rows)
    drawn = draw(run, embed=False)
    reason = "the target has no labels"
    assert {name for name, why in drawn.skipped.items() if why == reason} == {
        "confusion", "calibration",
    }  # fmt: skip
    assert reason in (page := drawn.page.read_text())
    assert "Clouds to turn</a>, in doubt first." in page
    axes = run_figures.pseudo_labels(read_run(run)).axes
    assert not any("precision" in str(each.get_label()) for each in axes[3].lines)
    assert len(run_figures.classes(read_run(run)).axes[1].containers) == 1


def test_stale_pictures_go(run):
    stale = run / "pictures" / "pseudo_labels.png"
    stale.parent.mkdir()
    stale.touch()
    change(run, rounds=[])
    for folder in run.glob("round_*"):
        shutil.rmtree(folder)
    skipped = draw(run, embed=False).skipped
    assert skipped["pseudo_labels"] == "the run has no rounds of self-training"
    assert not stale.exists()


def test_unfinished_run(run):
    (run / "metrics.json").unlink()
    (run / "predictions.csv").unlink()
    drawn = draw(run)
    with pytest.raises(MissingDataError, match="is not the folder of a run"):
        draw(run.parent)
    assert list(drawn.pictures) == ["curves", "pseudo_labels", "classes"]
    assert drawn.skipped["embedding"] == "the run is not finished"
    assert "not finished" in drawn.page.read_text()
    (run / "history.csv").write_text("epoch,phase,lr\n")
    assert "no epoch" in draw(run).skipped["curves"]
    for folder in run.glob("round_*"):
        shutil.rmtree(folder)
    skipped = draw(run, embed=False).skipped
    assert skipped["pseudo_labels"] == "the run has no rounds of self-training yet"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("history.csv", "epoch,phase\n0,zero\n"),
        ("history.csv", "a,b\n1,2\n"),
        ("predictions.csv", "id,mesh\n"),
        ("round_01/pseudo_labels.csv", "id,label,confidence,selected\na,ball,much,1\n"),
        ("round_01/pseudo_labels.csv", ""),
        ("metrics.json", "{"),
        ("metrics.json", "{}"),
        (".hydra/config.yaml", "a: [1"),
        (".hydra/config.yaml", laughs(9)),
    ],
)
def test_damaged_files_are_named(run, name, text, capsys):
    (run / name).write_text(text)
    with pytest.raises(DataError, match=re.escape(name)):
        draw(run, embed=False)
    assert main(["report", "page", f"run={run}"]) == 1
    assert name in capsys.readouterr().err


def use_real_net(run, target="qs3.models.pointnet.pointnet"):
    """A small net of ours in place of the toy's, with features."""
    torch.manual_seed(0)
    model = {"_target_": target, "num_classes": 3, "variant": "basic"}
    first, second = (pointnet(num_classes=3, variant="basic").state_dict() for _ in range(2))
    save(first, run / "warmup_selected.pt")
    result = Result(model, CLASSES, 32, 64, "kinectsim10", "z", "unit_ball", {}, second)
    write_result(run / "result.pt", result)


def why_no_embedding(run, data_dir=None):
    from qs3.report.runs.embedding import draw_embedding

    with pytest.raises(NothingToDrawError) as error:
        draw_embedding(read_run(run), data_dir)
    return str(error.value)


def test_embedding_needs_data_and_a_net(run, tmp_path):
    assert "tests.training.toy" in why_no_embedding(run)  # a file may not name any code
    use_real_net(run)
    assert f"its source, specklenet10, is not at {tmp_path}" in why_no_embedding(run, tmp_path)
    change(run, data=DataHashes(source="0" * 64, target="0" * 64))
    assert "another version of specklenet10" in why_no_embedding(run)
    (run / ".hydra" / "config.yaml").unlink()
    assert "config.yaml" in why_no_embedding(run)


def own_net(num_classes, variant):
    return pointnet(num_classes=num_classes, variant=variant)


def test_command_line_with_a_net_of_ones_own(run, toy_data, tmp_path, capsys):
    use_real_net(run, f"{__name__}.own_net")
    assert f"{__name__}.own_net, which is not in qs3.models" in why_no_embedding(run)
    out = tmp_path / "out"
    words = ["report", "page", f"run={run}", f"data_dir={toy_data}", f"out={out}"]
    assert main([*words, f"packages={__name__}"]) == 0
    named = [*ALL[:5], "embedding", *ALL[5:]]
    shown = [str(out / f"{name}.png") for name in named]
    shown += [str(out / "clouds.html"), str(out / "index.html")]
    assert capsys.readouterr().out.splitlines() == shown
    assert not_blank(out / "embedding.png")


def test_damaged_data_cost_their_pictures_and_not_the_page(run, toy_data, tmp_path, capsys):
    use_real_net(run)
    data_dir, out = tmp_path / "copy", tmp_path / "out"
    shutil.copytree(toy_data, data_dir)
    (data_dir / "kinectsim10" / "points.npy").write_bytes(b"no array")
    assert main(["report", "page", f"run={run}", f"data_dir={data_dir}", f"out={out}"]) == 0
    said = capsys.readouterr().out.splitlines()
    for name in ("embedding", "target_clouds"):
        assert any(line.startswith(f"no {name}: ") and "points.npy" in line for line in said)
    assert not_blank(out / "source_clouds.png")
    assert "Features of both domains: " in (out / "index.html").read_text()


def test_embedding_shows_both_domains_before_and_after(run):
    from qs3.report.runs.embedding import draw_embedding, sample

    use_real_net(run)
    figure = draw_embedding(read_run(run), clouds=9)
    assert [ax.get_title() for ax in figure.axes] == ["after the warm-up", "after self-training"]
    places = [np.concatenate([c.get_offsets() for c in ax.collections]) for ax in figure.axes]
    assert [len(p) for p in places] == [18, 18]
    assert np.abs(places[0] - places[1]).max() > 1e-3
    again = draw_embedding(read_run(run), clouds=9)
    np.testing.assert_array_equal(
        places[0], np.concatenate([c.get_offsets() for c in again.axes[0].collections])
    )
    assert sample(5, 9, seed=0).tolist() == [0, 1, 2, 3, 4]
    assert len(set(sample(100, 9, seed=0))) == 9
    assert sample(100, 9, seed=0).tolist() != sample(100, 9, seed=1).tolist()


def test_an_embedding_says_whose_classes_it_knows_and_unknown_ones_are_none_of_them():
    from matplotlib.colors import to_rgb

    from qs3.classes import CLASSES as TEN
    from qs3.report.runs.embedding import meaning

    domain = np.repeat([0, 1], 10)
    known, unknown = np.arange(10), np.full(10, -1)
    said = meaning(np.concatenate([known, unknown]), domain)
    assert said == "colours are the source's classes; those of the target are not known"
    assert meaning(np.concatenate([known, known]), domain).startswith("colours are true classes")
    labels, xy = np.concatenate([known, unknown]), np.zeros((20, 2))
    figure = run_figures.embedding("t", {"a": xy}, labels, domain, TEN, ("s", "t"))
    handles = {h.get_label(): to_rgb(h.get_color()) for h in figure.legends[0].legend_handles}
    plain = np.array(handles["unknown class"])
    for name in TEN:
        assert np.abs(plain - handles[name]).max() > 0.25, name


def test_training_draws_and_its_hash_does_not_know(toy):
    cfg = toy("report.pictures=true", "selftraining=none")
    assert hashing.config_sha256(cfg) == hashing.config_sha256(toy("selftraining=none"))
    train(cfg)
    pictures = hashing.run_folder(cfg) / "pictures"
    assert {p.name for p in pictures.iterdir()} == {
        *(f"{name}.png" for name in ALL if name != "pseudo_labels"), "clouds.html", "index.html",
    }  # fmt: skip


def test_a_failed_picture_is_a_warning(run, caplog):
    (run / "pictures").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        AfterTraining()(run)
    assert "the run is finished, but its pictures failed" in caplog.text
    assert "qs3 report page run=" in caplog.text


def test_offline_wandb_holds_config_curves_pictures_and_table(toy):
    cfg = toy("logger=wandb", "report.pictures=true")
    metrics = train(cfg)
    folder = hashing.run_folder(cfg)
    config, rows, summary, record = read(folder)
    assert (record.run_group, record.job_type) == ("quickstart", "train")
    assert (record.project, record.display_name) == ("qs3", "quickstart-seed0")
    assert record.run_id == hashing.run_name(cfg).replace("/", "-")
    assert list(record.tags) == list(cfg.logger.wandb.tags)
    assert {"specklenet10 -> kinectsim10", "qbst", "simulated"} <= set(record.tags)
    assert config["protocol"]["epochs"] == 4
    history = table(folder / "history.csv")
    losses = [row["train/loss"] for row in rows if "train/loss" in row]
    assert losses == pytest.approx([float(row["train/loss"]) for row in history])
    logged = {key: value for row in rows for key, value in row.items() if key.startswith("pict")}
    assert sorted(logged) == sorted(f"pictures/{name}" for name in ALL)
    (files,) = folder.glob("wandb/offline-run-*/files")
    for name in ALL:
        value = logged[f"pictures/{name}"]
        assert value["_type"] == "image-file"
        drawn = (folder / "pictures" / f"{name}.png").read_bytes()
        assert (files / value["path"]).read_bytes() == drawn
    (confusion,) = [row["confusion"] for row in rows if "confusion" in row]
    content = json.loads((files / confusion["path"]).read_text())
    assert content["columns"] == ["true class", *CLASSES]
    expected = metrics.final.confusion
    assert content["data"] == [[c, *row] for c, row in zip(CLASSES, expected, strict=True)]

    # The warm-up comes from that run: its epochs are in this one's log, too.
    other = toy("logger=wandb", "selftraining.theta=0.3")
    train(other)
    folder = hashing.run_folder(other)
    _, rows, _, _ = read(folder)
    history, keys = table(folder / "history.csv"), ("phase", "lr", "train/loss", "source_val/acc")
    assert len(history) == len(losses)
    assert [int(row["trainer/global_step"]) for row in rows] == [*range(len(history))]
    for row, written in zip(rows, history, strict=True):
        assert [row[key] for key in keys] == [float(written[key]) for key in keys]
    assert summary["final/accuracy"] == metrics.final.accuracy
    assert "WANDB_MODE" not in os.environ  # nor in the next job of a multirun
