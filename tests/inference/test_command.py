"""`qs3 predict`: files of every kind, damaged ones among them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import trimesh

import qs3
import qs3.inference.command
import qs3.inference.inputs
from qs3.config.location import typed
from qs3.errors import DataError
from qs3.geometry.sampling import surface_sample
from qs3.inference.model_file import read_result, write_result
from qs3.models.dgcnn import DGCNN
from qs3.runs.predictions import read_predictions
from qs3.store.store import open_pointset
from tests.running import main

ONE = (".xyz", ".txt", ".npy", ".npz", ".ply", ".pcd", ".h5", ".hdf5")


def write(path: Path, cloud: np.ndarray) -> None:
    """One cloud [n, 3], or several [m, n, 3] where the format can hold them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in cloud.reshape(-1, 3))
    if path.suffix in (".xyz", ".txt"):
        path.write_text(rows + "\n")
    elif path.suffix == ".npy":
        np.save(path, cloud)
    elif path.suffix == ".npz":
        np.savez(path, points=cloud)
    elif path.suffix == ".ply":
        head = "".join(f"property float {axis}\n" for axis in "xyz")
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex {len(cloud)}\n{head}end_header\n{rows}\n"
        )
    elif path.suffix == ".pcd":
        n = len(cloud)
        path.write_text(
            "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA ascii\n{rows}\n"
        )
    else:
        with h5py.File(path, "w") as file:
            file["data"] = cloud


def table(path: Path) -> list[dict[str, str]]:
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def probabilities(row: dict[str, str]) -> list[float]:
    return [float(value) for key, value in row.items() if key.startswith("p_")]


@pytest.fixture(scope="module")
def clouds(data_dir: Path) -> np.ndarray:
    return np.array(open_pointset(data_dir / "kinectsim10").split("test").points)


def predict(run: Path, source: Path, out: Path, *more: str) -> int:
    return main(["predict", f"ckpt={run}", f"input={source}", f"out={out}", "threads=2", *more])


def test_test_clouds_get_what_the_run_said(run, data_dir, clouds, tmp_path, capsys, caplog):
    np.save(tmp_path / "test.npy", clouds)
    out = tmp_path / "new" / "said.csv"
    with caplog.at_level("INFO"):
        assert predict(run, tmp_path / "test.npy", out, "batch_size=7") == 0
    assert "clouds: 24 of 24, " in caplog.text
    expected = read_predictions(run / "predictions.csv")
    rows = table(out)
    assert [row["file"] for row in rows] == [f"test.npy[{i}]" for i in range(24)]
    found = np.array([probabilities(row) for row in rows])
    np.testing.assert_allclose(found, expected.probabilities, atol=1e-6)
    assert [row["class"] for row in rows] == [expected.classes[i] for i in expected.predicted]
    for row, each in zip(rows, found, strict=True):
        assert row["status"] == "ok"
        assert float(row["confidence"]) == each.max()
        assert row["points"] == "64"
        assert (row["out_of_range"] == "yes") == bool(row["reason"])
    said = capsys.readouterr().out
    assert "24 clouds, " in said
    assert "clouds a second, from 1 file\n" in said
    assert said.endswith(f"saved {out}\nsaved {out.with_suffix('.html')}\n")
    assert predict(run, tmp_path / "test.npy", out, "page=false") == 0
    assert capsys.readouterr().out.endswith(f"saved {out} (replaced what was there)\n")


def test_a_net_of_metres_says_how_it_took_the_files(metric_run, run, clouds, tmp_path, capsys):
    np.save(tmp_path / "test.npy", clouds)
    np.save(tmp_path / "millimetres.npy", 1000 * clouds)
    for which, told in ((run, False), (metric_run, True)):
        out = tmp_path / "said.csv"
        assert predict(which, tmp_path / "test.npy", out, "page=false") == 0
        assert ("coordinates were taken as metres" in capsys.readouterr().out) == told
    expected = read_predictions(metric_run / "predictions.csv").probabilities
    np.testing.assert_allclose([probabilities(row) for row in table(out)], expected, atol=1e-6)
    assert predict(metric_run, tmp_path / "millimetres.npy", out, "page=false") == 0
    said = capsys.readouterr().out
    n = len(clouds)
    assert f"{n} of them as large as if they were not in metres, so these answers mean noth" in said
    assert "inches by 39.37" in said
    assert "organised" not in said
    assert all("size " in row["reason"] for row in table(out))


def test_a_net_of_heights_asks_where_the_floor_of_files_is(high_net, clouds, tmp_path, capsys):
    np.save(tmp_path / "test.npy", clouds)
    out = tmp_path / "said.csv"
    assert predict(high_net, tmp_path / "test.npy", out, "page=false") == 1
    assert "give floor=Z" in capsys.readouterr().err
    assert predict(high_net, tmp_path / "test.npy", out, "page=false", "floor=0.25") == 0
    expected = qs3.load(high_net)(list(clouds), floor=0.25)
    np.testing.assert_allclose([probabilities(row) for row in table(out)], expected, atol=1e-6)
    assert "camera counts as" not in capsys.readouterr().out


def test_a_bare_word_is_what_to_read(run, clouds, tmp_path, capsys):
    write(tmp_path / "a.xyz", clouds[0])
    with_key, bare = tmp_path / "key.csv", tmp_path / "bare.csv"
    assert predict(run, tmp_path / "a.xyz", with_key, "page=false") == 0
    assert main(["predict", str(tmp_path / "a.xyz"), f"ckpt={run}", f"out={bare}"]) == 0
    assert bare.read_text() == with_key.read_text()
    capsys.readouterr()
    assert main(["predict", "--help"]) == 0
    assert capsys.readouterr().out.startswith("qs3 predict PATH: classes and confidences of your")


def test_every_format_in_folders(run, clouds, tmp_path):
    folder = tmp_path / "scans"
    for i, suffix in enumerate(ONE):
        write(folder / f"{'deep/er/' * (i % 2)}cloud{i}{suffix}", clouds[i])
    (folder / "notes.md").write_text("passed over")
    (folder / ".hidden.xyz").write_text("not a cloud")
    out = tmp_path / "said.csv"
    assert predict(run, folder, out) == 0
    expected = qs3.load(run)(clouds[: len(ONE)])
    rows = {Path(row["file"]).name: row for row in table(out)}
    assert sorted(rows) == [f"cloud{i}{suffix}" for i, suffix in enumerate(ONE)]
    assert any(row["file"].startswith("deep/er/cloud1") for row in rows.values())
    for i, suffix in enumerate(ONE):
        row = rows[f"cloud{i}{suffix}"]
        np.testing.assert_allclose(probabilities(row), expected[i], atol=1e-6)
    single = tmp_path / "single.json"
    assert predict(run, folder / "cloud0.xyz", single) == 0
    (record,) = json.loads(single.read_text())["clouds"]
    assert record["file"] == "cloud0.xyz"
    np.testing.assert_allclose(list(record["probabilities"].values()), expected[0], atol=1e-6)


def test_of_a_mesh_the_surface_is_seen_and_not_its_corners(run, clouds, tmp_path, capsys):
    folder, out = tmp_path / "scans", tmp_path / "said.csv"
    folder.mkdir()
    box = trimesh.creation.box((0.5, 0.5, 0.75))
    box.export(folder / "box.ply")
    write(folder / "cloud.ply", clouds[0])
    assert predict(run, folder, out, "page=false") == 0
    rows = table(out)
    assert [row["points"] for row in rows] == ["8192", "64"]
    points = surface_sample(box.vertices, box.faces, 8192, np.random.default_rng(0))
    np.testing.assert_allclose(probabilities(rows[0]), qs3.load(run)([points])[0], atol=1e-6)
    said = capsys.readouterr().out
    assert "1 file is a mesh: points were drawn on its surface; to see it as a sensor" in said
    assert typed("python generate.py meshes=FOLDER\n") in said
    box.export(folder / "again.ply")
    assert predict(run, folder, out, "page=false") == 0
    assert "2 files are meshes: points were drawn on their surfaces; " in capsys.readouterr().out
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    line.export(folder / "line.ply")
    assert predict(run, folder, out, "page=false") == 1
    assert [row["file"] for row in table(out) if row["status"] == "failed"] == ["line.ply"]
    capsys.readouterr()
    assert predict(run, folder / "cloud.ply", out, "page=false") == 0
    assert "a mesh" not in capsys.readouterr().out


def test_damaged_files_are_listed_and_the_others_go_on(run, clouds, tmp_path, capsys):
    folder = tmp_path / "scans"
    write(folder / "a.xyz", clouds[0])
    (folder / "b.xyz").write_text("1 2 3\n4 five 6\n")
    (folder / "c.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\nend_header\n")
    np.save(folder / "d.npy", np.stack([clouds[1], clouds[1] * np.nan, clouds[2]]))
    np.save(folder / "e.npy", np.array([{}], dtype=object), allow_pickle=True)
    (folder / "f.txt").write_text("")
    write(folder / "g.pcd", clouds[3])
    large = clouds[0].astype("f8")
    large[4] = 1e300
    np.save(folder / "h.npy", large)
    for out in (tmp_path / "said.csv", tmp_path / "said.json"):
        assert predict(run, folder, out, "batch_size=2") == 1
    rows = table(tmp_path / "said.csv")
    status = {row["file"]: row["status"] for row in rows}
    good = {"a.xyz", "d.npy[0]", "d.npy[2]", "g.pcd"}
    assert {file for file, word in status.items() if word == "ok"} == good
    assert {file for file, word in status.items() if word == "failed"} == {
        *("b.xyz", "c.ply", "d.npy[1]", "e.npy", "f.txt", "h.npy")
    }
    assert list(status) == sorted(status)
    reasons = {row["file"]: row["reason"] for row in rows}
    assert not any(str(tmp_path) in reason for reason in reasons.values())  # that is `file`
    failed = next(row for row in rows if row["file"] == "b.xyz")
    assert {failed[key] for key in ("class", "confidence", "out_of_range", "p_ball")} == {""}
    expected = qs3.load(run)(clouds[:4])
    by_file = {row["file"]: row for row in rows}
    for file, i in (("a.xyz", 0), ("d.npy[0]", 1), ("d.npy[2]", 2), ("g.pcd", 3)):
        np.testing.assert_allclose(probabilities(by_file[file]), expected[i], atol=1e-6)
    records = json.loads((tmp_path / "said.json").read_text())
    assert records["classes"] == ["ball", "rod", "slab"]
    assert [r["file"] for r in records["clouds"]] == [row["file"] for row in rows]
    assert records["clouds"][1]["probabilities"] is None
    said = capsys.readouterr().out
    assert "4 clouds, " in said
    assert "6 failed:" in said
    assert "e.npy" in said


@pytest.mark.parametrize("suffix", [".xyz", ".pcd", ".h5", "many.npy"])
def test_points_that_are_not_finite_are_left_out_and_counted(run, clouds, tmp_path, suffix, capsys):
    rows = clouds[:2].astype("f8").repeat(2, axis=1)  # each point twice: the rest is all of it
    rows[0, 5], rows[0, 8, 1], rows[0, 9, 2] = np.nan, np.inf, -np.inf
    source = tmp_path / "in" / f"a{suffix}"
    write(source, rows if "many" in suffix else rows[0])
    assert predict(run, source.parent, tmp_path / "said.csv") == 0
    assert predict(run, source.parent, tmp_path / "said.json") == 0
    first, *others = table(tmp_path / "said.csv")
    assert (first["status"], first["points"], first["dropped"]) == ("ok", "125", "3")
    left = rows[0][np.isfinite(rows[0]).all(1)]
    np.testing.assert_allclose(probabilities(first), qs3.load(run)([left])[0], atol=1e-6)
    assert "finite" not in first["reason"]
    assert [row["dropped"] for row in others] == ["0"] * ("many" in suffix)
    assert json.loads((tmp_path / "said.json").read_text())["clouds"][0]["dropped"] == 3
    told = capsys.readouterr().out
    assert "left out of 1 cloud: 3 points, NaN, infinite or (0, 0, 0) (column dropped)" in told


def test_pixels_that_saw_nothing_are_no_points(run, clouds, tmp_path):
    np.save(tmp_path / "a.npy", np.vstack([clouds[0], np.zeros((20, 3))]))
    assert predict(run, tmp_path / "a.npy", tmp_path / "said.csv") == 0
    (row,) = table(tmp_path / "said.csv")
    assert (row["points"], row["dropped"]) == (str(len(clouds[0])), "20")
    np.testing.assert_allclose(probabilities(row), qs3.load(run)(clouds[:1])[0], atol=1e-6)
    with pytest.raises(DataError, match=r"cloud 0: 20 points are \(0, 0, 0\)"):
        qs3.load(run)([np.load(tmp_path / "a.npy")])


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_net_that_diverged_says_so_of_each_cloud(run, clouds, tmp_path, suffix):
    result = read_result(run)
    weights = {name: tensor * torch.nan for name, tensor in result.weights.items()}
    write_result(tmp_path / "nan.pt", replace(result, weights=weights))
    np.save(tmp_path / "a.npy", clouds[:2])
    out = tmp_path / f"said{suffix}"
    words = [f"ckpt={tmp_path / 'nan.pt'}", f"input={tmp_path / 'a.npy'}", f"out={out}"]
    assert main(["predict", *words]) == 1
    rows = table(out) if suffix == ".csv" else json.loads(out.read_text())["clouds"]
    assert [row["status"] for row in rows] == ["failed"] * 2
    assert all("its training has diverged" in row["reason"] for row in rows)
    words[0] = f"ckpt={run}"
    assert main(["predict", *words, f"second={tmp_path / 'nan.pt'}"]) == 0
    rows = table(out) if suffix == ".csv" else json.loads(out.read_text())["clouds"]
    assert all(row["class"] and not row["second"] for row in rows)


def test_a_device_without_memory_is_told(run, clouds, tmp_path, capsys, monkeypatch):
    """Only a GPU runs out of it; here the net says so."""

    def full(self: DGCNN, points: torch.Tensor) -> None:
        raise torch.OutOfMemoryError("Tried to allocate 20.00 MiB.\nand more")

    monkeypatch.setattr(DGCNN, "forward", full)
    np.save(tmp_path / "a.npy", clouds[:3])
    assert predict(run, tmp_path / "a.npy", tmp_path / "said.csv", "batch_size=2") == 1
    said = capsys.readouterr().err
    assert "ConfigError: device=cpu has no memory for 2 batches of 2 clouds at a time" in said
    assert "give a smaller batch_size=, or threads=1 (Tried to allocate 20.00 MiB.)" in said


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_what_was_said_before_ctrl_c_is_kept_beside_the_table(
    run, clouds, tmp_path, monkeypatch, caplog, capsys, suffix
):
    for i in range(30):
        write(tmp_path / f"in/{i:02}.npy", clouds[i % len(clouds)])
    real = qs3.inference.inputs.parse_clouds

    def parse(path: Path):
        if path.name == "29.npy":
            raise KeyboardInterrupt
        return real(path)

    words = [f"ckpt={run}", f"input={tmp_path / 'in'}", f"out={tmp_path / ('a' + suffix)}"]
    words += ["batch_size=4", "threads=1", "page=false"]
    assert main(["predict", *words]) == 0
    whole = (tmp_path / f"a{suffix}").read_text()
    monkeypatch.setattr(qs3.inference.inputs, "parse_clouds", parse)
    assert main(["predict", *words]) == 130
    assert capsys.readouterr().err.endswith("interrupted; out= was not written\n")
    part = tmp_path / f"a.part{suffix}"
    assert (tmp_path / f"a{suffix}").read_text() == whole, "a whole table was replaced"
    assert f"saved {part}, which is no whole table" in caplog.text
    if suffix == ".csv":
        lines = part.read_text().splitlines()
        assert 1 < len(lines) < 30
        assert whole.splitlines()[: len(lines)] == lines
    else:
        said = json.loads(part.read_text())
        assert json.loads(whole)["clouds"][: len(said["clouds"])] == said["clouds"]
        assert said["clouds"]
        assert said["trust"] is None


def test_progress_counts_clouds_where_files_are_few(run, clouds, tmp_path, caplog, monkeypatch):
    caplog.set_level("INFO", logger="qs3")
    np.save(tmp_path / "a.npy", clouds[:5])
    assert predict(run, tmp_path / "a.npy", tmp_path / "a.csv") == 0
    assert "clouds: 5 of 5, " in caplog.text
    assert predict(run, tmp_path / "a.npy", tmp_path / "a.csv", "sample=3") == 0
    assert "clouds: 3 of 3, " in caplog.text
    monkeypatch.setattr(qs3.inference.command, "FEW", 0)
    assert predict(run, tmp_path / "a.npy", tmp_path / "a.csv") == 0
    assert "files read: 1 of 1, " in caplog.text


def test_bytes_are_not_shown_as_they_are(run, tmp_path, capsys):
    (tmp_path / "a.xyz").write_bytes(b"\x1b[31m\x00\xff\xfe\x07 binary\r more\n" * 9)
    assert predict(run, tmp_path / "a.xyz", tmp_path / "said.csv") == 1
    said = capsys.readouterr().out
    assert all(c.isprintable() for c in said.replace("\n", ""))
    assert said.isascii()
    (row,) = table(tmp_path / "said.csv")
    assert row["reason"].startswith(r"line 1: '\x1b[31m\x00\xff\xfe\x07 binary")
    assert row["reason"].isascii()
    assert row["reason"].isprintable()


def test_lines_of_an_organised_scan_are_no_clouds(run, clouds, tmp_path, capsys):
    """[h, w, 3], as other software has it; clouds of one file that are usual say nothing of it."""
    lines = clouds[0][np.argsort(clouds[0][:, 2])].reshape(8, -1, 3)
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "organised.npy", lines)
    np.save(tmp_path / "in" / "several.npy", clouds[:9])
    assert predict(run, tmp_path / "in", tmp_path / "said.csv", "page=false") == 0
    said = capsys.readouterr().out
    assert "organised.npy is an array of 8 clouds, all out of range: if it is one" in said
    assert "several.npy is" not in said


def test_up_and_flags(run, clouds, tmp_path):
    y_up = np.stack([clouds[0][:, 0], clouds[0][:, 2], -clouds[0][:, 1]], 1)
    write(tmp_path / "in" / "a.xyz", y_up)
    write(tmp_path / "in" / "b.xyz", y_up[:9])
    write(tmp_path / "in" / "c.xyz", y_up * (1, 1e-4, 1))
    assert predict(run, tmp_path / "in", tmp_path / "said.csv", "up=y") == 0
    rows = table(tmp_path / "said.csv")
    np.testing.assert_allclose(probabilities(rows[0]), qs3.load(run)(clouds[:1])[0], atol=1e-6)
    assert [row["out_of_range"] for row in rows] == ["no", "yes", "yes"]
    assert "points 9 is under 32" in rows[1]["reason"]
    assert "height" in rows[2]["reason"]
    assert [row["points"] for row in rows] == ["64", "9", "64"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["predict", "ckpt={run}"], "give input=PATH for clouds, or depth=PATH"),
        (["predict", "ckpt={run}", "{clouds}", "input={clouds}"], "input= is given twice"),
        (["predict", "ckpt={run}", "{clouds}", "b.xyz"], "b.xyz is another; of several files give"),
        (["predict", "ckpt={run}", "{run}/nothing"], "is not there"),
        (["predict", "ckpt={run}", "--fast"], "'--fast' is not key=value; keys are ckpt, second"),
        (
            ["predict", "ckpt={run}", "input={clouds}", "gravity=z"],
            "unknown key 'gravity'; keys are",
        ),
        (["predict", "ckpt={run}", "input={clouds}", "out=a.txt"], "must end in .csv or .json"),
        (["predict", "ckpt={run}", "input={clouds}", "out=a.csv"], "a.csv is a folder; give the"),
        (["predict", "ckpt={run}", "input={clouds}", "out=b.csv"], "b.html is a folder; give the"),
        (["predict", "ckpt={run}", "input={clouds}", "up=w"], "up must be one of"),
        (["predict", "ckpt={run}", "input={clouds}", "batch_size=0"], "batch_size must be"),
        (["predict", "ckpt={run}", "input={clouds}", "device=quantum"], "device=quantum"),
        (["predict", "ckpt={run}", "input={run}/nothing"], "is not there"),
        (["predict", "ckpt={run}", "input={empty}"], "holds no file of"),
        (
            ["predict", "ckpt={run}", "input={run}/metrics.json"],
            "metrics.json: unknown format; known are",
        ),
        (["predict", "ckpt={run}", "input={other}.stl"], "A mesh is scanned first: qs3-generate"),
        (["predict", "ckpt={run}", "input={other}.png"], "For depth images there is depth=FILE"),
        (["predict", "ckpt={run}", "input={other}.csv"], "Rows of x y z are .txt or .xyz"),
        (["predict", "ckpt={run}/nothing", "input={clouds}"], "is not there"),
        (["predict", "ckpt={run}", "{dataset}"], "give input={dataset}/points.npy"),
        (["export", "ckpt={run}", "out=model.h5"], "must end in .onnx or .pt2"),
        (["export"], "ckpt=RUN is missing"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_mistakes_are_told_in_words(
    run, data_dir, clouds, tmp_path, capsys, monkeypatch, words, message
):
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "a.csv", "b.html"):
        (tmp_path / folder).mkdir()
    write(tmp_path / "a.xyz", clouds[0])
    for suffix in (".stl", ".png", ".csv"):
        (tmp_path / f"other{suffix}").touch()
    places = {"run": run, "clouds": tmp_path / "a.xyz", "empty": tmp_path / "empty"}
    places |= {"other": tmp_path / "other", "dataset": data_dir / "kinectsim10"}
    threads = torch.get_num_threads()
    assert main([word.format(**places) for word in words]) == 1
    assert torch.get_num_threads() == threads
    assert message.format(**places) in capsys.readouterr().err
    assert not (tmp_path / "model.onnx").exists()
    assert not (tmp_path / "predictions.csv").exists()
    assert not (tmp_path / "b.csv").exists()


def test_names_that_are_no_utf8(run, clouds, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    try:
        Path(f"{folder}/\udcff.xyz").write_text("0 0 0\n1 2 3\n")
    except OSError:
        pytest.skip("this file system takes no such names")
    assert predict(run, folder, tmp_path / "said.csv") == 0
    assert table(tmp_path / "said.csv")[0]["file"] == r"\xff.xyz"


def test_folders_that_are_no_utf8_and_names_with_commands_for_a_terminal(
    run, clouds, tmp_path, capsys, monkeypatch
):
    folder = tmp_path / "m\udcf6bel"
    try:
        write(folder / "a.xyz", clouds[0])
    except OSError:
        pytest.skip("this file system takes no such names")
    (folder / "bad\x1b[31mname\n.xyz").write_text("x y\n")
    (folder / "a.\x1b[31m").write_text("")
    assert predict(run, folder, folder / "said.csv") == 1  # file that failed
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert r"bad\x1b[31mname\n.xyz: " in said
    assert rf"{tmp_path}/m\xf6bel/said.html" in said
    assert r"<title>m\xf6bel, as " in (folder / "said.html").read_text()
    monkeypatch.chdir(folder)
    assert predict(run, Path("."), tmp_path / "here.csv") == 1
    assert r"<title>m\xf6bel, as " in (tmp_path / "here.html").read_text()
