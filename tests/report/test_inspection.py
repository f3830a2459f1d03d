"""What `qs3 inspect` and `qs3 compare` measure has known answers."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.errors import ConfigError
from qs3.report import inspection
from qs3.report.datasets import chosen, open_named
from qs3.report.viewer import drawn
from qs3.store.meta import ManifestRow
from qs3.store.store import write_pointset
from tests.fixtures import published as fixtures
from tests.report.made_runs import not_blank
from tests.running import main


def grid(side=8):
    """A flat square of side x side points, 1 apart."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)


def test_an_even_grid_has_one_spacing():
    of = inspection.one_cloud(grid())
    radius = np.hypot(3.5, 3.5)
    assert (of["x"], of["y"], of["z"], of["largest"], of["floor"]) == (7, 7, 0, 7, 0)
    assert of["nn_median"] == pytest.approx(1 / radius)
    assert of["nn_variation"] == pytest.approx(0, abs=1e-5)
    assert of["copies"] == 0
    assert of["radius"] == of["off_centre"] == pytest.approx(radius)


def test_copies():
    of = inspection.one_cloud(np.concatenate([grid(), grid()[:16], [[100, 0, 0]]]))
    assert of["copies"] == pytest.approx(16 / 81)
    assert inspection.one_cloud(np.zeros((10, 3)))["copies"] == pytest.approx(0.9)


def test_directions_of_a_sphere_and_of_its_upper_half():
    x = np.random.default_rng(0).normal(size=(20000, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    assert inspection.coverage(x) == (1, 1)
    assert inspection.coverage(x[x[:, 2] > 0]) == (0.5, 0)


def store(folder, clouds, ids, splits, classes=("a", "b"), meta=None, **more):
    rows = [ManifestRow(i, i.split("/")[0], s) for i, s in zip(ids, splits, strict=True)]
    return write_pointset(
        folder, name="s", classes=classes, arrays={"points": clouds, **more}, rows=rows,
        meta=meta or {},
    )  # fmt: skip


def test_a_cloud_in_train_and_test_is_a_leak(tmp_path):
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(5, 32, 3)).astype(np.float32)
    clouds[3] = clouds[0][rng.permutation(32)]  # in another order
    clouds[2] = clouds[1]  # both in train, of two classes
    ids = ["a/0", "a/1", "b/2", "a/3", "b/4"]
    data = store(tmp_path / "s", clouds, ids, ["train"] * 3 + ["test"] * 2)
    rows = [
        ManifestRow("x", "a", "train", mesh_sha256="1"),
        ManifestRow("y", "a", "test", mesh_sha256="1"),
        ManifestRow("z", "a", "test", mesh_sha256="2"),
    ]
    found = inspection.copies(data, rows)
    assert (found["clouds"], found["leaks"], found["contradicting_labels"]) == (2, 1, 1)
    assert (found["meshes"], found["leaking_meshes"]) == (2, 1)
    assert [[*group] for group in found["groups"]] == [["a/0", "a/3"], ["a/1", "b/2"]]
    opened = open_named(str(tmp_path / "s"), {})
    text = inspection.domain_text(opened, inspection.measured(opened, 9))
    assert "WARNING: 1 clouds in the test split and in another one, too" in text


def test_a_sample_is_drawn_and_always_the_same(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(9, 16, 3))
    store(tmp_path / "s", clouds, [f"a/{i}" for i in range(9)], ["train"] * 9)
    opened = open_named(str(tmp_path / "s"), {})
    some = inspection.measured(opened, 4)
    assert len(some) == 4
    assert [*some["id"]] == sorted({*some["id"]})
    assert some.equals(inspection.measured(opened, 4))


class Labelled:
    def __init__(self, labels):
        self.labels = np.array(labels)
        self.ids = [f"{label}/{i}" for i, label in enumerate(labels)]


@given(st.lists(st.integers(-1, 3), min_size=1, max_size=40), st.integers(1, 45))
def test_as_many_of_each_class_as_there_is_room_for(labels, most):
    found = chosen(Labelled(labels), most)
    assert len({*found}) == len(found) == min(most, len(labels))
    got = {k: sum(labels[i] == k for i in found) for k in {*labels}}
    for k, count in got.items():  # only who has no more has fewer than another by two
        assert count == labels.count(k) or count >= max(got.values()) - 1
    assert chosen(Labelled([0, 1, 0, 1, 0]), 9, "0/") == [0, 2, 4]


def test_the_clean_twin_is_the_truth(tmp_path):
    clouds, clean = np.random.default_rng(0).normal(size=(2, 3, 6, 3))
    store(tmp_path, clouds, ["a/0", "b/1", "a/2"], ["train"] * 3, points_clean=clean)
    found = inspection.surface(open_named(str(tmp_path), {}), [0, 2])
    off = []
    for cloud, twin in zip(clouds.astype("f4")[[0, 2]], clean.astype("f4")[[0, 2]], strict=True):
        every = np.linalg.norm(cloud[:, None].astype(float) - twin[None], axis=2).min(axis=1)
        off.append(every / np.linalg.norm(twin - twin.mean(axis=0), axis=1).max())
    assert found["off"] == pytest.approx(np.median(off), rel=1e-5)
    assert inspection.surface(open_named(str(tmp_path), {"variant": "points_clean"}), [0]) == {}


def test_one_dataset_against_itself_has_no_gap_and_others_need_a_common_class(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(8, 64, 3))
    ids = [f"{'ab'[i % 2]}/{i}" for i in range(8)]
    for name, of in (("s", ids), ("bare", [f"/{i}" for i in range(8)])):
        store(tmp_path / name, clouds, of, ["train"] * 8, points_clean=clouds)
    opened, bare = (open_named(str(tmp_path / name), {}) for name in ("s", "bare"))
    facts = inspection.compare(opened, opened)
    assert facts["prior"] == {"a": {"A": 0.5, "B": 0.5}, "b": {"A": 0.5, "B": 0.5}}
    assert facts["cloud"][0] == facts["cloud"][1]
    assert facts["cloud"][0]["off_95"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(ConfigError):
        inspection.compare(opened, bare)


def furniture(folder, ids):
    clouds = [np.random.default_rng(i).normal(size=(20, 3)) for i in range(len(ids))]
    return store(folder, clouds, ids, ["train"] * len(ids), ("bed", "chair", "sofa"))


def test_same_object_in_all_domains_where_possible(tmp_path, monkeypatch):
    a = furniture(tmp_path / "a", ["bed/1", "bed/2", "chair/1"])
    b = furniture(tmp_path / "b", ["bed/3", "bed/2", "sofa/1"])
    shown = []
    monkeypatch.setattr(inspection, "contact_sheet", lambda *given, **_: shown.extend(given))
    inspection.scan_picture({"A": a, "B": b}, "train")
    clouds, titles, columns = shown
    assert titles == ["bed", "bed", "no sofa", "sofa", "chair", "no chair"]
    assert columns == 4
    for cloud, (data, i) in zip(clouds[:2], [(a, 1), (b, 1)], strict=True):
        np.testing.assert_array_equal(cloud, data.points[i])


def test_what_is_drawn_is_not_at_even_steps():
    """Families of a catalogue take turns: at even steps all shown would be of one."""
    found = drawn(np.arange(100), 10)
    assert found == sorted({*found})
    assert len({i % 10 for i in found}) > 4
    assert drawn(np.array([5, 7]), 2) == [5, 7]


def test_commands(tmp_path, capsys):
    for name in ("modelnet10", "kinectsim10"):
        fixtures.write_domain(name, tmp_path, {"train": 1, "test": 1})
    words = ["inspect", "modelnet10", f"data_dir={tmp_path}", f"out={tmp_path / 'i'}"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "20 clouds of 2048 points" in said
    assert "made of: published files" in said
    assert len((tmp_path / "i" / "inspection.csv").read_text().splitlines()) == 21
    assert "20 of 20 clouds of" in (tmp_path / "i" / "clouds.html").read_text()
    words = ["compare", "modelnet10", f"{tmp_path}/kinectsim10", f"out={tmp_path / 'c'}"]
    assert main([*words, f"a.paths.data_dir={tmp_path}", "b.variant=points_clean"]) == 0
    assert not_blank(tmp_path / "c" / "clouds.png")
    facts = json.loads((tmp_path / "c" / "comparison.json").read_text())
    assert facts["cloud"][0]["directions"] > 0
    assert (tmp_path / "c" / "comparison.md").read_text().startswith("# A = ModelNet10")
    for wrong in (["nothing10"], ["modelnet10", "variantt=points"], ["/nowhere/at/all"]):
        assert main(["inspect", *wrong]) == 1
    assert main(["compare", "modelnet10"]) == 1
    assert main(["inspect", f"{tmp_path}/kinectsim10", "path=x"]) == 1
