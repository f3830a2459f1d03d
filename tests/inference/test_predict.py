"""`qs3 predict` of clouds: files of every kind, damaged ones among them; archives of objects."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import qs3
from qs3.evaluation.prior import read_prior
from qs3.geometry.sampling import surface_sample
from qs3.inference import model_file
from qs3.inference.export import export_folder
from qs3.inference.model_file import read_result, write_result
from qs3.inference.predict import DISPUTED
from qs3.runs.metrics import read_metrics
from qs3.runs.predictions import read_predictions
from qs3.store.store import open_pointset
from tests.inference.conftest import predict, probabilities, table
from tests.running import main


def write(path: Path, cloud: np.ndarray) -> None:
    """One cloud [n, 3] as text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, cloud, fmt="%.9g")


@pytest.fixture(scope="module")
def clouds(data_dir: Path) -> np.ndarray:
    return np.array(open_pointset(data_dir / "kinectsim10").split("test").points)


def test_test_clouds_get_the_predictions_of_the_run(run, clouds, tmp_path, capsys):
    np.save(tmp_path / "points.npy", clouds)
    (tmp_path / "manifest.csv").write_text("")  # as in a dataset, of which its points are read
    out = tmp_path / "new" / "said.csv"
    assert predict(run, out, f"input={tmp_path}", "batch_size=7") == 0
    expected = read_predictions(run / "predictions.csv")
    rows = table(out)
    assert [row["file"] for row in rows] == [f"points.npy[{i}]" for i in range(24)]
    found = np.array([probabilities(row) for row in rows])
    np.testing.assert_allclose(found, expected.probabilities, atol=1e-6)
    assert [row["class"] for row in rows] == [expected.classes[i] for i in expected.predicted]
    for row, each in zip(rows, found, strict=True):
        assert float(row["confidence"]) == each.max()
        assert (row["status"], row["points"]) == ("ok", "64")
        assert (row["out_of_range"] == "yes") == bool(row["reason"])
    printed = capsys.readouterr().out
    assert "24 clouds, " in printed
    data = read_metrics(run).data_text
    assert f"the classifier's data: {data}\n" in printed
    assert data in html.unescape(out.with_suffix(".html").read_text())


def test_metres_and_heights(metric_run, high_net, clouds, tmp_path, capsys):
    np.save(tmp_path / "test.npy", clouds)
    np.save(tmp_path / "millimetres.npy", 1000 * clouds)
    out = tmp_path / "said.csv"
    assert predict(metric_run, out, str(tmp_path / "test.npy"), "page=false") == 0
    expected = read_predictions(metric_run / "predictions.csv").probabilities
    np.testing.assert_allclose([probabilities(row) for row in table(out)], expected, atol=1e-6)
    assert predict(metric_run, out, str(tmp_path / "millimetres.npy"), "page=false") == 0
    assert f"{len(clouds)} are too large for metres" in capsys.readouterr().out
    assert all("size " in row["reason"] for row in table(out))
    for words, floor in ((["floor=0.25"], 0.25), (["camera_height=1.5"], -1.5), ([], None)):
        assert predict(high_net, out, str(tmp_path / "test.npy"), "page=false", *words) == 0
        expected = qs3.load(high_net)(list(clouds), floor=floor)
        np.testing.assert_allclose([probabilities(row) for row in table(out)], expected, atol=1e-6)
        assert ("the camera counts as 1.25 m" in capsys.readouterr().out) == (floor is None)
    standing = replace(read_result(high_net), floor_m=0.0)
    write_result(tmp_path / "standing.pt", standing)
    assert predict(tmp_path / "standing.pt", out, str(tmp_path / "test.npy")) == 1
    assert "floor=" in capsys.readouterr().err


def test_files_of_folders_are_read_and_others_counted(run, clouds, tmp_path, capsys):
    folder = tmp_path / "scans"
    write(folder / "cloud0.xyz", clouds[0])
    write(folder / "deep" / "er" / "cloud1.txt", clouds[1])
    np.savez(folder / "deep" / "cloud2.npz", points=clouds[2])
    (folder / "notes.md").write_text("passed over")
    (folder / ".hidden.xyz").write_text("not a cloud")
    assert predict(run, tmp_path / "said.csv", str(folder)) == 0
    assert "passed over: 1 .md" in capsys.readouterr().out
    rows = table(tmp_path / "said.csv")
    names = ["cloud0.xyz", "deep/cloud2.npz", "deep/er/cloud1.txt"]
    assert [row["file"] for row in rows] == names
    expected = qs3.load(run)(clouds[[0, 2, 1]])
    np.testing.assert_allclose([probabilities(row) for row in rows], expected, atol=1e-6)


def test_of_a_mesh_the_surface_is_seen_and_not_its_corners(run, tmp_path):
    box = trimesh.creation.box((0.5, 0.5, 0.75))
    box.export(tmp_path / "box.ply")
    assert predict(run, tmp_path / "said.csv", str(tmp_path / "box.ply"), "page=false") == 0
    (row,) = table(tmp_path / "said.csv")
    assert row["points"] == "8192"
    points = surface_sample(box.vertices, box.faces, 8192, np.random.default_rng(0))
    np.testing.assert_allclose(probabilities(row), qs3.load(run)([points])[0], atol=1e-6)


def test_damaged_files_are_listed_and_the_others_go_on(run, clouds, tmp_path, capsys):
    folder = tmp_path / "scans"
    write(folder / "a.xyz", clouds[0])
    (folder / "b.xyz").write_text("1 2 3\n4 five 6\n")
    (folder / "c.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\nend_header\n")
    np.save(folder / "d.npy", np.stack([clouds[1], clouds[1] * np.nan, clouds[2]]))
    np.save(folder / "e.npy", np.array([{}], dtype=object), allow_pickle=True)
    (folder / "f.txt").write_text("")
    (folder / "g.xyz").write_bytes(b"\x1b[31m\x00\xff\xfe\x07 binary\r more\n" * 9)
    assert predict(run, tmp_path / "said.csv", str(folder), "batch_size=2") == 1
    rows = table(tmp_path / "said.csv")
    status = {row["file"]: row["status"] for row in rows}
    assert list(status) == sorted(status)
    good = {"a.xyz": 0, "d.npy[0]": 1, "d.npy[2]": 2}
    assert {file for file, word in status.items() if word == "ok"} == {*good}
    assert len(rows) == 9
    expected, by_file = qs3.load(run)(clouds[:3]), {row["file"]: row for row in rows}
    for file, i in good.items():
        np.testing.assert_allclose(probabilities(by_file[file]), expected[i], atol=1e-6)
    failed = by_file["b.xyz"]
    assert {failed[key] for key in ("class", "confidence", "out_of_range", "p_ball")} == {""}
    reasons = [row["reason"] for row in rows if row["status"] == "failed"]
    assert not any(str(tmp_path) in reason or not reason.isprintable() for reason in reasons)
    printed = capsys.readouterr().out
    assert "6 failed:" in printed
    assert all(c.isprintable() for c in printed.replace("\n", ""))


def test_points_without_depth_are_left_out_and_counted(run, clouds, tmp_path):
    rows = clouds[0].astype("f8").repeat(2, axis=0)  # each point twice: the rest is all of it
    rows[5], rows[8, 1], rows[9, 2] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "a.npy", np.vstack([rows, np.zeros((20, 3))]))
    assert predict(run, tmp_path / "said.csv", str(tmp_path / "a.npy")) == 0
    (row,) = table(tmp_path / "said.csv")
    assert (row["status"], row["points"], row["dropped"]) == ("ok", "125", "23")
    left = rows[np.isfinite(rows).all(1)]
    np.testing.assert_allclose(probabilities(row), qs3.load(run)([left])[0], atol=1e-6)


def test_clouds_of_a_net_that_diverged_fail(run, clouds, tmp_path):
    result = read_result(run)
    weights = {name: tensor * torch.nan for name, tensor in result.weights.items()}
    write_result(tmp_path / "nan.pt", replace(result, weights=weights))
    np.save(tmp_path / "a.npy", clouds[:2])
    out = tmp_path / "said.csv"
    assert predict(tmp_path / "nan.pt", out, str(tmp_path / "a.npy")) == 1
    assert [row["status"] for row in table(out)] == ["failed"] * 2
    assert all("its training has diverged" in row["reason"] for row in table(out))
    assert predict(run, out, str(tmp_path / "a.npy"), f"second={tmp_path / 'nan.pt'}") == 0
    assert all(row["class"] and not row["second"] for row in table(out))


def test_up_and_flags(run, clouds, tmp_path):
    y_up = np.stack([clouds[0][:, 0], clouds[0][:, 2], -clouds[0][:, 1]], 1)
    write(tmp_path / "in" / "a.xyz", y_up)
    write(tmp_path / "in" / "b.xyz", y_up[:9])
    write(tmp_path / "in" / "c.xyz", y_up * (1, 1e-4, 1))
    assert predict(run, tmp_path / "said.csv", str(tmp_path / "in"), "up=y") == 0
    rows = table(tmp_path / "said.csv")
    np.testing.assert_allclose(probabilities(rows[0]), qs3.load(run)(clouds[:1])[0], atol=1e-6)
    assert [row["out_of_range"] for row in rows] == ["no", "yes", "yes"]
    assert "points 9 is under 32" in rows[1]["reason"]
    assert "height" in rows[2]["reason"]
    assert [row["points"] for row in rows] == ["64", "9", "64"]


def test_labels_are_those_of_files_or_folders(run, tmp_path, capsys):
    rng = np.random.default_rng(0)
    for name in ("Rod/new/a.npy", "c.npy", "d/stool.npz"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
    np.save(tmp_path / "in/Rod/new/a.npy", rng.normal(size=(64, 3)))
    np.savez(tmp_path / "in/b.npz", points=rng.normal(size=(2, 64, 3)), label=[2, 0])
    np.save(tmp_path / "in/c.npy", rng.normal(size=(64, 3)))
    np.savez(tmp_path / "in/d/stool.npz", points=rng.normal(size=(1, 64, 3)), label=["stool"])
    assert predict(run, tmp_path / "said.csv", str(tmp_path / "in")) == 0
    found = {row["file"]: row["label"] for row in table(tmp_path / "said.csv")}
    assert found == {
        "Rod/new/a.npy": "rod", "b.npz[0]": "slab", "b.npz[1]": "ball", "c.npy": "",
        "d/stool.npz[0]": "stool",
    }  # fmt: skip
    printed = capsys.readouterr().out
    assert re.search(r"right [0-3] of 3 \(", printed)
    assert "not classes, left out: stool 1" in printed


@pytest.mark.parametrize(
    "words", [[], ["{at}/a.xyz", "depth={at}/a.png"], ["{at}/a.xyz", "up=w"], ["{at}/nothing"]]
)
def test_mistakes_are_errors(run, clouds, tmp_path, words):
    write(tmp_path / "a.xyz", clouds[0])
    given = [word.format(at=tmp_path) for word in words]
    assert predict(run, tmp_path / "said.csv", *given) == 1
    assert not (tmp_path / "said.csv").exists()


def test_names_for_terminals_and_pages_are_printable(run, clouds, tmp_path, capsys):
    folder = tmp_path / "m\udcf6bel"
    try:
        write(folder / "a.xyz", clouds[0])
    except OSError:
        pytest.skip("this file system takes no such names")
    (folder / "bad\x1b[31mname\n.xyz").write_text("x y\n")
    (folder / "a.\x1b[31m").write_text("")
    assert predict(run, folder / "said.csv", str(folder)) == 1
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert r"bad\x1b[31mname\n.xyz: " in printed
    assert rf"{tmp_path}/m\udcf6bel/said.html" in printed
    assert r"<title>m\udcf6bel, as " in (folder / "said.html").read_text()


def test_a_prior_is_that_of_python(run, clouds, tmp_path):
    np.save(tmp_path / "a.npy", clouds)
    out, words = tmp_path / "said.csv", ("page=false", "prior=rod:8,ball:0", "prior_power=1")
    assert predict(run, out, str(tmp_path / "a.npy"), *words) == 0
    given = {"rod": 8, "ball": 0}
    expected = qs3.load(run, prior=given, prior_power=1)(clouds)
    np.testing.assert_allclose([probabilities(row) for row in table(out)], expected, atol=1e-6)
    assert (expected[:, 0] == 0).all()
    plain = qs3.load(run)(clouds)
    by_hand = read_prior(given, ("ball", "rod", "slab"), read_result(run).shares, 1)(plain)
    np.testing.assert_allclose(expected, by_hand)


def test_a_second_classifier_is_asked_and_counted(run, clouds, tmp_path, capsys):
    first = qs3.load(run)
    other = replace(first.result, classes=("slab", "ball", "rod"))  # never the same
    write_result(tmp_path / "other.pt", other)
    best = first(clouds[:6]).argmax(axis=1)
    labels = [first.classes[k] for k in best[:3]] + [other.classes[k] for k in best[3:]]
    np.savez(tmp_path / "labelled.npz", points=clouds[:6], label=labels)
    out, words = tmp_path / "said.csv", [str(tmp_path / "labelled.npz")]
    assert predict(run, out, *words, f"second={tmp_path}/other.pt") == 0
    assert "agrees on 0, differs on 6 (50% right) (column second)" in capsys.readouterr().out
    names = dict(zip(first.classes, other.classes, strict=True))
    assert [row["second"] for row in table(out)] == [names[row["class"]] for row in table(out)]
    assert f"{DISPUTED}: " in out.with_suffix(".html").read_text()
    assert predict(run, out, *words, f"second={run}") == 0
    assert "agrees on 6 (50% right), differs on 0 (column second)" in capsys.readouterr().out
    assert DISPUTED not in out.with_suffix(".html").read_text()
    assert predict(run, out, *words, "page=false") == 0
    assert "second classifier" not in capsys.readouterr().out
    write_result(tmp_path / "more.pt", replace(other, classes=("slab", "ball", "cup")))
    assert predict(run, out, *words, f"second={tmp_path}/more.pt") == 1


def test_without_a_name_the_floor_decides(run, high_net, tmp_path, monkeypatch, capsys):
    """Toy nets under the names of those that come with qs3."""
    monkeypatch.setattr(model_file, "PRETRAINED", tmp_path / "pretrained")
    for name, net in ((model_file.ANY_SIZE, run), (model_file.HEIGHTS, high_net)):
        export_folder(net, tmp_path / "pretrained" / name)
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(90, 3)))
    monkeypatch.chdir(tmp_path)
    for words, name in (
        (["a.npy"], model_file.ANY_SIZE),
        (["a.npy", "floor=0"], model_file.HEIGHTS),
        (["a.npy", "camera_height=1.2"], model_file.HEIGHTS),
    ):
        assert main(["predict", *words]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith(f"classifier: {name}, which comes with qs3 (ckpt=)\n")
        assert ("a second classifier agrees on " in printed) == (name == model_file.HEIGHTS)
    assert main(["predict", "a.npy", "floor=0", "second=none"]) == 0
    assert "second classifier" not in capsys.readouterr().out


def test_labels_show_right_and_wrong(run, clouds, tmp_path, capsys):
    labels = np.array(["ball", "rod", "slab", "cup"] * 6)
    np.savez(tmp_path / "labelled.npz", points=clouds, label=labels)
    out = tmp_path / "said.csv"
    assert predict(run, out, f"{tmp_path}/labelled.npz") == 0
    rows = table(out)
    assert [row["label"] for row in rows] == labels.tolist()
    judged = [row for row in rows if row["label"] != "cup"]
    right = [row for row in judged if row["label"] == row["class"]]
    printed = capsys.readouterr().out
    assert f"right {len(right)} of {len(judged)} (" in printed
    assert "labels that are not classes, left out: cup 6" in printed
    page = out.with_suffix(".html").read_text()
    assert f"{len(right)} of {len(judged)} right" in page
    cards = re.findall(r'"card wrong">.*?class="said">(\w+) (\d+)%', page, flags=re.DOTALL)
    assert len(cards) == len(judged) - len(right) > 1
    sure = [int(percent) for _, percent in cards]
    assert sure == sorted(sure, reverse=True)
