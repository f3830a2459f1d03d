"""`qs3 view` of everything that it takes: what is shown, in which order, and what it refuses."""

import json

import numpy as np
import pytest
import trimesh

from qs3.runs.metrics import read_metrics
from qs3.store.store import open_pointset
from tests.fixtures.frame_files import write_archive
from tests.report.made_runs import table
from tests.report.viewer.reading import data_of, places
from tests.running import main
from tests.training.toy import CLASSES, write_domain

RNG = np.random.default_rng(0)


@pytest.fixture
def view(tmp_path, monkeypatch, capsys):
    """Runs the command in an empty folder: its status, what it said, and the page's data."""
    monkeypatch.chdir(tmp_path)

    def called(*words):
        status = main(["view", *map(str, words)])
        said = capsys.readouterr()
        page = tmp_path / "view.html"
        return status, said.out + said.err, data_of(page.read_text()) if page.exists() else None

    return called


def names(data):
    return [cloud["name"] for cloud in data["clouds"]]


def of_run(folder):
    """[name, label, called] of a run's predictions, the surest first, and which are wrong."""
    rows = table(folder / "predictions.csv")
    rows.sort(key=lambda row: -float(row[f"p_{row['predicted']}"]))
    return rows, [row for row in rows if row["label"] != row["predicted"]]


def test_files_of_all_kinds_with_their_labels(view, tmp_path):
    cloud = RNG.normal(size=(40, 3))
    folder = tmp_path / "scans"
    for name in ("chair", "lamp/old"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "chair" / "a.xyz", cloud)
    np.save(folder / "lamp" / "old" / "b.npy", np.stack([cloud, cloud + 1]))
    np.savez(folder / "c.npz", points=cloud[None], label=np.array(["sofa"]))
    np.save(folder / "holes.npy", np.concatenate([cloud, [[np.nan] * 3]]))
    (folder / "notes.pdf").touch()
    status, said, data = view("scans")
    assert status == 0
    assert "4 of 4 files in scans, 5 clouds; 1 file of another kind passed over: .pdf 1" in said
    assert "saved view.html" in said
    assert [(c["name"], c["label"], c["note"]) for c in data["clouds"]] == [
        ("c.npz[0]", "sofa", ""), ("chair/a.xyz", "chair", ""),
        ("holes.npy", "", "1 point without depth left out"),
        ("lamp/old/b.npy[0]", "old", ""), ("lamp/old/b.npy[1]", "old", ""),
    ]  # fmt: skip
    for found in data["clouds"]:
        np.testing.assert_allclose(places(found), cloud - cloud.min(axis=0), atol=1e-4)
    assert "(replaced what was there)" in view("scans", "match=lamp", "up=y")[1]
    _, _, turned = view("scans", "match=lamp", "up=y")
    assert names(turned) == ["lamp/old/b.npy[0]", "lamp/old/b.npy[1]"]
    want = np.stack([cloud[:, 0], -cloud[:, 2], cloud[:, 1]], axis=1)  # y up
    np.testing.assert_allclose(places(turned["clouds"][0]), want - want.min(axis=0), atol=1e-4)


def test_meshes_are_shown_by_samples_of_their_surface(view, tmp_path):
    solid = trimesh.creation.box((1, 2, 3))
    for name in ("table/box.ply", "table/box.off"):
        (tmp_path / "table").mkdir(exist_ok=True)
        solid.export(tmp_path / name)
    np.savetxt(tmp_path / "cloud.xyz", RNG.normal(size=(9, 3)))
    trimesh.PointCloud(solid.vertices).export(tmp_path / "table" / "corners.ply")
    (tmp_path / "table" / "cut.stl").write_bytes(b"solid\nfacet normal")
    status, said, data = view(".", "points=4000", "up=y")
    assert status == 1
    assert "not read: table/cut.stl: " in said
    found = {cloud["name"]: cloud for cloud in data["clouds"]}
    assert found["table/corners.ply"]["count"] == 8  # of a cloud, as it is
    for name in ("table/box.ply", "table/box.off"):
        assert found[name]["label"] == "table"
        assert found[name]["note"] == "samples of 12 faces"
        assert found[name]["size"] == pytest.approx([1, 3, 2], abs=0.01)  # y up
        points = places(found[name])
        on = np.isclose(points, 0, atol=1e-3) | np.isclose(points, [1, 3, 2], atol=1e-3)
        assert on.any(axis=1).all()
        assert found[name]["count"] == 4000


def test_damaged_files_are_named_and_the_others_shown(view, tmp_path):
    np.savetxt(tmp_path / "good.xyz", RNG.normal(size=(9, 3)))
    (tmp_path / "bad.ply").write_bytes(b"ply\nno")
    (tmp_path / "words.txt").write_text("a b c\n")
    np.save(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    status, said, data = view(".")
    assert status == 1
    assert names(data) == ["good.xyz"]
    for name in ("bad.ply", "words.txt", "nan.npy"):
        assert f"not read: {name}: " in said
        assert f"not read: {name}: " in (tmp_path / "view.html").read_text()
    (tmp_path / "good.xyz").unlink()
    (tmp_path / "view.html").unlink()
    status, said, data = view(".")
    assert status == 1
    assert "DataError: there is no cloud to show\nbad.ply: " in said
    assert data is None


def test_several_paths_share_the_page(view, tmp_path):
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", RNG.normal(size=(30, 12, 3)))
    status, said, data = view("a.npy", "b.npy", "clouds=8", "points=5", "colour=height")
    assert status == 0
    assert len(data["clouds"]) == 8
    assert {name[0] for name in names(data)} == {"a", "b"}
    assert {(c["count"], c["of"]) for c in data["clouds"]} == {(5, 12)}
    assert "a.npy, 4 of 30 clouds\nb.npy, 4 of 30 clouds\n" in said
    assert "a.npy, 4 of 30 clouds" in (tmp_path / "view.html").read_text()
    assert f"2 of 2 files in {tmp_path.name}, 7 of 60 clouds\n" in view(".", "clouds=7")[1]
    assert "at most 5 points of a cloud are shown" in said


def test_an_archive_of_objects(view, tmp_path):
    arrays = write_archive(tmp_path / "objects.npz", {"train": 1, "test": 1}, points=90)
    status, said, data = view("objects.npz")
    assert status == 0
    shown = arrays["dev"] != "judge"  # which is looked at once, and not here
    count = int(shown.sum())
    assert 0 < count < len(shown)
    assert f"{count} of {count} objects of objects.npz without the part judge" in said
    assert data["unit"] == "m"
    assert [c["label"] for c in data["clouds"]] == sorted(arrays["cls"][shown])
    for found in data["clouds"]:
        i = int(found["name"].split("/")[1])
        part = slice(arrays["start"][i], arrays["start"][i + 1])
        xyz = arrays["xyz_tenth_mm"][part][arrays["inlier"][part]] / 1e4
        np.testing.assert_allclose(places(found), xyz - xyz.min(axis=0), atol=1e-4)


def test_an_archive_without_parts_is_shown_whole(view, tmp_path):
    arrays = write_archive(tmp_path / "objects.npz", {"train": 1, "test": 1}, dev=False, points=90)
    status, said, _ = view("objects.npz")
    assert status == 0
    count = len(arrays["cls"])
    assert f"{count} of {count} objects of objects.npz" in said
    assert "without" not in said


def test_a_dataset(view, tmp_path):
    write_domain(tmp_path / "data", "kinectsim10", noise=0.05)
    status, said, data = view("data/kinectsim10", "clouds=7", "match=/test/")
    assert status == 0
    stored = open_pointset(tmp_path / "data" / "kinectsim10")
    assert "7 of 96 clouds of kinectsim10" in said
    labels = [c["label"] for c in data["clouds"]]
    assert labels == sorted(labels)
    assert sorted({labels.count(name) for name in CLASSES}) == [2, 3]
    for found in data["clouds"]:
        assert "/test/" in found["name"]
        cloud = stored.points[stored.ids.index(found["name"])]
        np.testing.assert_allclose(places(found), cloud - cloud.min(axis=0), atol=1e-4)
    words = ["kinectsim10", f"data_dir={tmp_path / 'data'}"]
    assert view(*words)[0] == 0  # by the name of its domain


def test_a_run_s_most_confident_errors_come_first(view, run):
    rows, wrong = of_run(run)
    assert 3 < len(wrong) < len(rows)
    status, said, data = view(run)
    assert status == 0
    assert f"{len(wrong)} are wrong, the most confident first" in said
    assert "kinectsim10 (simulated)" in said
    made = read_metrics(run).made_of
    assert f"the target is made of: {made.target}; trained on specklenet10 ({made.source})" in said
    right = [row for row in rows[::-1] if row["label"] == row["predicted"]]
    assert names(data) == [row["id"] for row in (*wrong, *right)]
    for found, row in zip(data["clouds"], (*wrong, *right), strict=True):
        assert (found["label"], found["called"]) == (row["label"], row["predicted"])
        assert found["sure"] == pytest.approx(float(row[f"p_{row['predicted']}"]))
    assert {"class", "confidence"} <= {*data["modes"]}
    assert names(view(run, "clouds=3")[2]) == [row["id"] for row in wrong[:3]]
    ball = [row["id"] for row in wrong if "ball" in row["id"]]
    assert names(view(run, "match=ball")[2])[: len(ball)] == ball


def test_runs_that_cannot_be_shown(view, run, tmp_path):
    status, said, _ = view(run, f"data_dir={tmp_path}")
    assert status == 1
    assert "its target, kinectsim10, is not at" in said
    (run / "predictions.csv").unlink()
    assert "MissingDataError" in (said := view(run)[1])
    assert "no predictions: its predictions.csv is gone" in said
    (run / "metrics.json").write_text(json.dumps({}))
    assert "DataError" in view(run)[1]
    (run / "metrics.json").unlink()
    assert "no predictions: it is a run that did not finish; repeat its command" in view(run)[1]
    (failed := tmp_path / "failed" / ".hydra").mkdir(parents=True)
    (failed / "config.yaml").write_text("")
    (failed.parent / "train.log").write_text("")
    assert view(failed.parent)[1].endswith("is a run that did not finish; repeat its command\n")


def test_fewer_clouds_than_paths_are_refused(view, tmp_path):
    names = [f"{k}.npy" for k in range(4)]
    for name in names:
        np.save(tmp_path / name, RNG.normal(size=(5, 3)))
    status, said, data = view(*names, "clouds=3")
    assert (status, data) == (1, None)
    assert "clouds=3 is less than one for each of 4 paths; give clouds=4, or a folder" in said
    assert len(view(*names, "clouds=4")[2]["clouds"]) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "missing argument: qs3 view PATH"),
        (["nowhere"], "nowhere is not there: give a file or folder of clouds"),
        (["a.pdf"], "a.pdf: unknown format; known are .xyz"),
        (["."], ". holds no file of .xyz"),
        (["a.npy", "match=z"], "match=z: no cloud of a.npy has that in its name"),
        (["a.npy", "colour=view"], "colour=view: nothing is known of it here; there are height"),
        (["a.npy", "colour=red"], "colour must be height or view"),
        (["a.npy", "out=a.png"], "out=a.png must end in .html"),
        (["a.npy", "clouds=501"], "clouds=501: a page holds 500 at most"),
        (["a.npy", "points=200001"], "points=200001: a cloud on a page has 200000 at most"),
        (["a.npy", "up=w"], "up must be one of"),
    ],
)
def test_mistakes_are_told(view, tmp_path, words, message):
    if "a.npy" in words:
        np.save(tmp_path / "a.npy", RNG.normal(size=(5, 3)))
    (tmp_path / "a.pdf").touch()
    status, said, data = view(*words)
    assert status == 1
    assert message in said
    assert data is None
