"""`qs3 view` of everything that it takes: what is shown, in which order."""

import numpy as np
import pytest
import trimesh

from qs3.runs.metrics import read_metrics
from qs3.store.store import open_pointset
from tests.fixtures.frame_files import write_archive
from tests.report.made_runs import table
from tests.report.pages import data_of, places
from tests.running import main
from tests.training.toy import CLASSES, write_domain

RNG = np.random.default_rng(0)


@pytest.fixture
def view(tmp_path, monkeypatch, capsys):
    """Runs the command in an empty folder: its status, what it printed, and the page's data."""
    monkeypatch.chdir(tmp_path)

    def called(*words):
        status = main(["view", *map(str, words)])
        said = capsys.readouterr()
        page = tmp_path / "view.html"
        return status, said.out + said.err, data_of(page.read_text()) if page.exists() else None

    return called


def names(data):
    return [cloud["name"] for cloud in data["clouds"]]


def test_files_of_all_kinds_with_their_labels(view, tmp_path):
    cloud = RNG.normal(size=(40, 3))
    folder = tmp_path / "scans"
    for name in ("chair", "lamp/old"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "chair" / "a.xyz", cloud)
    np.save(folder / "lamp" / "old" / "b.npy", np.stack([cloud, cloud + 1]))
    np.savez(folder / "c.npz", points=cloud[None], label=np.array(["sofa"]))
    np.save(folder / "holes.npy", np.concatenate([cloud, [[np.nan] * 3]]))
    status, said, data = view("scans")
    assert status == 0
    assert "4 of 4 files in scans, 5 of 5 clouds" in said
    assert [(c["name"], c["label"], c["note"]) for c in data["clouds"]] == [
        ("c.npz[0]", "sofa", ""), ("chair/a.xyz", "chair", ""),
        ("holes.npy", "", "1 points without depth left out"),
        ("lamp/old/b.npy[0]", "old", ""), ("lamp/old/b.npy[1]", "old", ""),
    ]  # fmt: skip
    for found in data["clouds"]:
        np.testing.assert_allclose(places(found), cloud - cloud.min(axis=0), atol=1e-4)
    _, _, turned = view("scans", "match=lamp", "up=y")
    assert names(turned) == ["lamp/old/b.npy[0]", "lamp/old/b.npy[1]"]
    want = np.stack([cloud[:, 0], -cloud[:, 2], cloud[:, 1]], axis=1)  # y up
    np.testing.assert_allclose(places(turned["clouds"][0]), want - want.min(axis=0), atol=1e-4)


def test_meshes_are_shown_by_samples_of_their_surface_and_damage_is_named(view, tmp_path):
    (tmp_path / "table").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "table" / "box.off")
    (tmp_path / "table" / "cut.stl").write_bytes(b"solid\nfacet normal")
    np.save(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    status, said, data = view(".", "points=4000", "up=y")
    assert status == 1
    for name in ("table/cut.stl", "nan.npy"):
        assert f"not read: {name}: " in said
    (found,) = data["clouds"]
    assert (found["label"], found["count"]) == ("table", 4000)
    assert found["size"] == pytest.approx([1, 3, 2], abs=0.01)  # y up
    points = places(found)
    on = np.isclose(points, 0, atol=1e-3) | np.isclose(points, [1, 3, 2], atol=1e-3)
    assert on.any(axis=1).all()


def test_several_paths_share_the_page(view, tmp_path):
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", RNG.normal(size=(30, 12, 3)))
    status, _, data = view("a.npy", "b.npy", "clouds=8", "points=5")
    assert status == 0
    assert [name[0] for name in names(data)] == [*"aaaabbbb"]
    assert {(c["count"], c["of"]) for c in data["clouds"]} == {(5, 12)}


def test_an_archive_of_objects_without_the_part_that_judges(view, tmp_path):
    arrays = write_archive(tmp_path / "objects.npz", {"train": 1, "test": 1}, points=90)
    status, _, data = view("objects.npz")
    assert status == 0
    shown = arrays["dev"] != "judge"
    assert 0 < shown.sum() < len(shown)
    assert [c["label"] for c in data["clouds"]] == sorted(arrays["cls"][shown])
    for found in data["clouds"]:
        i = int(found["name"].split("/")[1])
        part = slice(arrays["start"][i], arrays["start"][i + 1])
        xyz = arrays["xyz_tenth_mm"][part][arrays["inlier"][part]] / 1e4
        np.testing.assert_allclose(places(found), xyz - xyz.min(axis=0), atol=1e-4)


def test_a_dataset(view, tmp_path):
    write_domain(tmp_path / "data", "kinectsim10", noise=0.05)
    status, said, data = view("data/kinectsim10", "clouds=7", "match=/test/")
    assert status == 0
    stored = open_pointset(tmp_path / "data" / "kinectsim10")
    assert "7 of 96 clouds of kinectsim10" in said
    labels = [c["label"] for c in data["clouds"]]
    assert sorted({labels.count(name) for name in CLASSES}) == [2, 3]
    for found in data["clouds"]:
        cloud = stored.points[stored.ids.index(found["name"])]
        np.testing.assert_allclose(places(found), cloud - cloud.min(axis=0), atol=1e-4)
    assert view("kinectsim10", f"data_dir={tmp_path / 'data'}")[0] == 0  # by its domain's name


def test_a_run_s_most_confident_errors_come_first(view, run):
    rows = table(run / "predictions.csv")
    rows.sort(key=lambda row: -float(row[f"p_{row['predicted']}"]))
    wrong = [row for row in rows if row["label"] != row["predicted"]]
    right = [row for row in rows[::-1] if row["label"] == row["predicted"]]
    assert 3 < len(wrong) < len(rows)
    status, said, data = view(run)
    assert status == 0
    made = read_metrics(run).made_of
    assert f"the target is made of: {made.target}; trained on specklenet10 ({made.source})" in said
    assert names(data) == [row["id"] for row in (*wrong, *right)]
    for found, row in zip(data["clouds"], (*wrong, *right), strict=True):
        assert (found["label"], found["called"]) == (row["label"], row["predicted"])
        assert found["sure"] == pytest.approx(float(row[f"p_{row['predicted']}"]))
    ball = [row["id"] for row in wrong if "ball" in row["id"]]
    assert names(view(run, "match=ball")[2])[: len(ball)] == ball


@pytest.mark.parametrize("words", [["nowhere"], ["a.pdf"], ["."], ["a.npy", "match=z"]])
def test_nothing_to_show(view, tmp_path, words):
    (tmp_path / "a.pdf").touch()
    if words[0] == "a.npy":
        np.save(tmp_path / "a.npy", RNG.normal(size=(5, 3)))
    status, said, data = view(*words)
    assert (status, data) == (1, None)
    assert "Error: " in said
