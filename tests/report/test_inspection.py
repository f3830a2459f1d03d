"""What `qs3 inspect` and `qs3 compare` measure has known answers."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from qs3.catalogue import Catalogue
from qs3.errors import ConfigError
from qs3.generation.kept import NO_RESIDUAL_M, PROVENANCE
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import UnitCube
from qs3.report import inspection
from qs3.report.datasets import chosen, distance_to_mesh, open_named, part_of, surfaces_of
from qs3.store.meta import ManifestRow
from qs3.store.store import write_pointset
from qs3.utils.seeding import object_rng
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
    assert of["nn_low"] == pytest.approx(of["nn_high"])
    assert of["nn_variation"] == pytest.approx(0, abs=1e-5)
    assert of["nn_stored"] == pytest.approx(1)
    assert of["copies"] == of["lonely"] == 0
    assert of["radius"] == of["off_centre"] == pytest.approx(radius)


def test_copies_and_lonely_points():
    of = inspection.one_cloud(np.concatenate([grid(), grid()[:16], [[100, 0, 0]]]))
    assert of["copies"] == pytest.approx(16 / 81)
    assert of["lonely"] == pytest.approx(1 / 65)
    assert inspection.one_cloud(np.zeros((10, 3)))["copies"] == pytest.approx(0.9)


def test_directions_of_a_sphere_and_of_its_upper_half():
    x = np.random.default_rng(0).normal(size=(20000, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    assert inspection.coverage(x) == (1, 1)
    assert inspection.coverage(x[x[:, 2] > 0]) == (0.5, 0)


def test_slices_do_not_know_how_a_cloud_is_turned_about_z():
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(400, 3)) * [1, 0.3, 2]
    turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    turned = np.column_stack([cloud[:, :2] @ turn, cloud[:, 2]])
    assert inspection.slices(cloud).shape == (53,)
    axis = np.column_stack([cloud[:, :2] @ [[0, 1], [-1, 0]], cloud[:, 2]])
    np.testing.assert_allclose(inspection.slices(axis), inspection.slices(cloud), atol=1e-9)
    shares = inspection.slices(turned)[:10] ** 2
    np.testing.assert_allclose(shares, inspection.slices(cloud)[:10] ** 2, atol=1e-9)
    assert shares.sum() == pytest.approx(1)


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


def test_a_size_is_odd_beside_many_alike(tmp_path):
    """Of three clouds none is: two that happen to be alike say nothing of the third."""
    rng = np.random.default_rng(0)
    sizes = np.array([1, 1.01, 1.3, *rng.uniform(0.9, 1.1, 8), 1000])
    clouds = (rng.uniform(-1, 1, (12, 64, 3)) * sizes[:, None, None]).astype(np.float32)
    for count, odd in ((3, []), (12, ["a/11"])):
        ids = [f"a/{i}" for i in range(count)]
        store(tmp_path / str(count), clouds[:count], ids, ["train"] * count)
        opened = open_named(str(tmp_path / str(count)), {})
        assert inspection.odd_sizes(inspection.measured(opened, 99)) == odd


def test_a_sample_is_drawn_and_always_the_same(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(9, 16, 3))
    store(tmp_path / "s", clouds, [f"a/{i}" for i in range(9)], ["train"] * 9)
    opened = open_named(str(tmp_path / "s"), {})
    some = inspection.measured(opened, 4)
    assert len(some) == 4
    assert [*some["id"]] == sorted({*some["id"]})
    assert some.equals(inspection.measured(opened, 4))


def distances(points, mesh):
    """[n] distance of each point from a mesh, by that from every triangle."""
    corners = mesh.vertices[mesh.faces]  # [f, 3, 3]
    every = (closest_point(corners, np.tile(p, (len(corners), 1))) - p for p in points)
    return np.array([np.linalg.norm(to, axis=1).min() for to in every])


def test_distance_to_a_mesh_is_that_of_brute_force():
    mesh = Catalogue(train=1, test=0, classes=("chair",)).items()[0].load()
    rng = np.random.default_rng(0)
    points = rng.uniform(mesh.bounds[0] - 0.2, mesh.bounds[1] + 0.2, (60, 3))
    found = distance_to_mesh(points, mesh)
    np.testing.assert_allclose(found, distances(points, mesh), atol=1e-9)
    one = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    points = np.array([[0.2, 0.2, 0.5], [2, 0, 0], [-3, -4, 0], [1, 1, 0]])
    assert distance_to_mesh(points, one) == pytest.approx([0.5, 1, 5, np.sqrt(0.5)])


SOURCE = {"_target_": "qs3.catalogue.Catalogue", "seed": 3, "train": 2, "test": 0,
          "classes": ["chair"]}  # fmt: skip


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Random points about two chairs of the catalogue; the second is another mesh by its hash."""
    folder = tmp_path_factory.mktemp("generated")
    items = Catalogue(seed=3, train=2, test=0, classes=("chair",)).items()
    placed = [UnitCube().place(i.load(), object_rng(5, i.id, 0), i.id) for i in items]
    rng = np.random.default_rng(0)
    hashes = (items[0].load().sha256, "0" * 64)
    write_pointset(
        folder, name="s", classes=("chair",),
        arrays={"points": [rng.uniform(*mesh.bounds, (20, 3)) for mesh in placed]},
        rows=[ManifestRow(item.id, "chair", "train", mesh_sha256=sha)
              for item, sha in zip(items, hashes, strict=True)],
        meta={"settings": {"seed": 5, "recipe": {}, "meshes": SOURCE}},
    )  # fmt: skip
    return open_named(str(folder), {}), placed


def test_the_mesh_is_the_truth_where_it_can_be_made_again(generated):
    opened, placed = generated
    part = part_of(opened, [0, 1])
    assert part.residual_of == "distance to the mesh"
    known, other = part.shown
    np.testing.assert_allclose(known.residual, distances(known.points, placed[0]), atol=1e-6)
    assert other.residual is None
    found = inspection.surface(opened, ["chair"])
    assert found["truth"] == "mesh"
    assert found["median"] == pytest.approx(np.median(known.residual), rel=1e-5)
    evil = {"seed": 0, "recipe": {"placing": {"_target_": "os.system", "command": "false"}}}
    assert surfaces_of({"settings": {**evil, "meshes": SOURCE}}) is None
    assert surfaces_of({}) is None


def test_without_meshes_the_clean_twin_is_the_truth(tmp_path):
    clouds, clean = np.random.default_rng(0).normal(size=(2, 3, 6, 3))
    ids = ["a/0", "b/1", "a/2"]
    store(tmp_path / "s", clouds, ids, ["train"] * 3, points_clean=clean)
    opened = open_named(str(tmp_path / "s"), {})
    part = part_of(opened, [0, 1, 2])
    assert "clean twin" in part.residual_of
    for one, twin in zip(part.shown, opened.twin.points, strict=True):
        every = np.linalg.norm(one.points[:, None] - twin[None].astype(float), axis=2)
        np.testing.assert_allclose(one.residual, every.min(axis=1))
    assert part_of(opened, [0], residuals=False).shown[0].residual is None
    found = inspection.surface(opened, ["a"])
    off = [cKDTree(clean[i].astype("f4")).query(clouds[i].astype("f4"))[0] for i in (0, 2)]
    assert (found["truth"], found["median"]) == ("clean twin", pytest.approx(np.median(off)))


def test_provenance_gives_views_and_errors_of_the_measured_points_alone(tmp_path):
    table = np.zeros((2, 6, 5))
    table[..., 0] = np.arange(6) % 4
    table[..., 3] = [0.1, -0.2, NO_RESIDUAL_M, 0, 0.3, -0.4]
    clouds, clean = np.random.default_rng(0).normal(size=(2, 2, 6, 3))
    write_pointset(
        tmp_path, name="s", classes=("a",),
        rows=[ManifestRow(f"a/{i}", "a", "train") for i in "01"],
        arrays={"points": clouds, "points_clean": clean, "provenance": table}, meta={},
        tables={"provenance": PROVENANCE},
    )  # fmt: skip
    part = part_of(open_named(str(tmp_path), {}), [1, 0], residuals=False)  # these cost nothing
    assert [one.name for one in part.shown] == ["a/1", "a/0"]
    for one in part.shown:
        np.testing.assert_array_equal(one.view, np.arange(6) % 4)
        np.testing.assert_allclose(one.residual, [0.1, 0.2, np.nan, 0, 0.3, 0.4], rtol=1e-6)
    clean_part = part_of(open_named(str(tmp_path), {"variant": "points_clean"}), [0])
    assert clean_part.shown[0].view is clean_part.shown[0].residual is None


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


def test_nearest_neighbours_are_those_of_all_distances():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(30, 4)), rng.normal(0.7, 2, size=(30, 4))
    x = np.concatenate([a, b])
    x = np.clip((x - x.mean(axis=0)) / x.std(axis=0), -5, 5)
    own = 0
    for i in range(60):
        others = [j for j in range(60) if j != i]
        nearest = min(others, key=lambda j: np.linalg.norm(x[i] - x[j]))
        own += (nearest < 30) == (i < 30)
    assert inspection.own_neighbours(a, b) == own / 60
    assert inspection.own_neighbours(a, a + 9) == 1


def test_one_dataset_against_itself_has_no_gap_and_others_need_a_common_class(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(8, 64, 3))
    ids = [f"{'ab'[i % 2]}/{i}" for i in range(8)]
    for name, of in (("s", ids), ("bare", [f"/{i}" for i in range(8)])):
        store(tmp_path / name, clouds, of, ["train"] * 8, points_clean=clouds)
    opened, bare = (open_named(str(tmp_path / name), {}) for name in ("s", "bare"))
    facts = inspection.compare(opened, opened)
    assert facts["prior"] == {"a": {"A": 0.5, "B": 0.5}, "b": {"A": 0.5, "B": 0.5}}
    assert facts["told_apart"]["all"] < 0.5  # the twin in the other set is the nearest
    assert facts["cloud"][0] == facts["cloud"][1]
    assert facts["surface"][0]["p95"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(ConfigError):
        inspection.compare(opened, bare)


def test_commands(tmp_path, capsys):
    for name in ("modelnet10", "kinectsim10"):
        fixtures.write_domain(name, tmp_path, {"train": 2, "test": 1})
    words = ["inspect", "modelnet10", f"data_dir={tmp_path}", f"out={tmp_path / 'i'}"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "30 clouds of 2048 points" in said
    assert "made of: published files" in said
    assert len((tmp_path / "i" / "inspection.csv").read_text().splitlines()) == 31
    assert not_blank(tmp_path / "i" / "clouds.png")
    assert "30 of 30 clouds of" in (tmp_path / "i" / "clouds.html").read_text()
    words = ["compare", "modelnet10", f"{tmp_path}/kinectsim10", f"out={tmp_path / 'c'}"]
    assert main([*words, f"a.paths.data_dir={tmp_path}", "b.variant=points_clean"]) == 0
    facts = json.loads((tmp_path / "c" / "comparison.json").read_text())
    assert 0 <= facts["told_apart"]["density"] <= 1
    assert (tmp_path / "c" / "comparison.md").read_text().startswith("# A = ModelNet10")
    for wrong in (["nothing10"], ["modelnet10", "variantt=points"], ["/nowhere/at/all"]):
        assert main(["inspect", *wrong]) == 1
    assert main(["compare", "modelnet10"]) == 1
    assert main(["inspect", f"{tmp_path}/kinectsim10", "path=x"]) == 1
