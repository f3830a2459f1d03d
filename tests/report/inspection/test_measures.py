"""Measures against known answers and brute force."""

import json

import numpy as np
import pytest
from trimesh.triangles import closest_point

from qs3.catalogue import Catalogue
from qs3.errors import ConfigError
from qs3.generation.recipes import SurfaceSamples
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import UnitCube
from qs3.report.inspection import gap, measures
from qs3.report.inspection.measure import WITHIN, Bounds, compare
from qs3.report.inspection.open_dataset import open_named
from qs3.report.inspection.surface import distance_to_mesh, surfaces_of
from qs3.store.meta import MadeOf
from qs3.store.store import ManifestRow, write_pointset
from qs3.utils.seeding import object_rng
from tests.fixtures import published as fixtures
from tests.running import main


def grid(side=8):
    """A flat square of side x side points, 1 apart."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)


def test_an_even_grid_has_one_spacing():
    of = measures.one_cloud(grid())
    radius = np.hypot(3.5, 3.5)
    assert of["nn_median"] == pytest.approx(1 / radius)
    assert of["nn_low"] == pytest.approx(of["nn_high"])
    assert of["nn_variation"] == pytest.approx(0, abs=1e-5)
    assert of["copies"] == of["lonely"] == 0
    assert of["radius"] == pytest.approx(radius)


def test_copies_and_lonely_points():
    cloud = np.concatenate([grid(), grid()[:16], [[100, 0, 0]]])
    of = measures.one_cloud(cloud.astype(np.float32))
    assert of["copies"] == pytest.approx(16 / 81)
    assert of["lonely"] == pytest.approx(1 / 65)
    few = measures.one_cloud(np.zeros((10, 3), dtype=np.float32))
    assert few["copies"] == pytest.approx(0.9)


def test_directions_of_a_sphere_and_of_its_upper_half():
    x = np.random.default_rng(0).normal(size=(20000, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    assert measures._directions(x) == (1, 1)
    assert measures._directions(x[x[:, 2] > 0]) == (0.5, 0)


def store(folder, clouds, ids, splits, classes=("a", "b"), **meta):
    rows = [ManifestRow(i, i.split("/")[0], s) for i, s in zip(ids, splits, strict=True)]
    return write_pointset(
        folder, name="s", classes=classes, arrays={"points": clouds}, rows=rows, meta=meta
    )


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
    found = measures.copies(data, rows)
    assert (found["clouds"], found["leaks"], found["contradicting_labels"]) == (2, 1, 1)
    assert (found["meshes"], found["leaking_meshes"]) == (2, 1)


def test_a_size_is_odd_beside_many_alike(tmp_path):
    """Of three clouds of any kind none is: two that happen to be alike say nothing of the third."""
    rng = np.random.default_rng(0)
    sizes = np.array([1, 1.01, 1.3, *rng.uniform(0.9, 1.1, 8), 1000])
    clouds = rng.uniform(-1, 1, (12, 64, 3)) * sizes[:, None, None]
    clouds = clouds.astype(np.float32)
    for count, odd in ((3, []), (12, ["11"])):
        ids = [str(i) for i in range(count)]
        rows = [ManifestRow(i, "", "train") for i in ids]
        arrays = {"points": clouds[:count]}
        data = write_pointset(
            tmp_path / str(count), name="s", classes=["a"], arrays=arrays, rows=rows, meta={}
        )
        assert measures.extents(data, np.arange(count))["odd_sizes"] == odd
    out = tmp_path / "said"
    assert main(["inspect", str(tmp_path / "12"), f"out={out}", "sheets=0"]) == 0
    said = (out / "inspection.txt").read_text()
    assert "odd sizes: 1: 11" in said  # of no class: nothing of "their class"
    assert f"..{np.ptp(clouds[11], axis=0).max():.0f} " in said  # millimetres, not 2e+03


def test_clouds_without_labels_cannot_be_compared_and_that_is_said(tmp_path, capsys):
    points = np.random.default_rng(0).normal(size=(2, 32, 3)).astype(np.float32)
    for name, cls in (("a", "bed"), ("b", ""), ("c", "")):
        rows = [ManifestRow(f"{name}/{i}", cls, "train") for i in range(2)]
        arrays = {"points": points}
        write_pointset(
            tmp_path / name, name=name, classes=["bed"], arrays=arrays, rows=rows, meta={}
        )
    for others, bare in (("ab", "b"), ("cb", "c and b")):
        words = [str(tmp_path / one) for one in others]
        assert main(["compare", *words, f"out={tmp_path / 'out'}"]) == 1
        said = capsys.readouterr().err
        assert f"have no class in common: the clouds of {bare} have no labels" in said


def distances(points, mesh):
    """[n] distance of each point from a mesh, by that from every triangle."""
    corners = mesh.vertices[mesh.faces]  # [f, 3, 3]
    every = (closest_point(corners, np.tile(p, (len(corners), 1))) - p for p in points)
    return np.array([np.linalg.norm(to, axis=1).min() for to in every])


def test_distance_to_a_mesh_is_that_of_brute_force():
    mesh = Catalogue(train=1, test=0, classes=("chair",)).items()[0].load()
    rng = np.random.default_rng(0)
    points = rng.uniform(mesh.bounds[0] - 0.2, mesh.bounds[1] + 0.2, (60, 3))
    found = distance_to_mesh(points, mesh, rng)
    np.testing.assert_allclose(found, distances(points, mesh), atol=1e-9)


def test_distance_to_one_triangle():
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    points = np.array([[0.2, 0.2, 0.5], [2, 0, 0], [-3, -4, 0], [1, 1, 0]])
    found = distance_to_mesh(points, mesh, np.random.default_rng(0))
    assert found == pytest.approx([0.5, 1, 5, np.sqrt(0.5)])


CATALOGUE = {"_target_": "qs3.catalogue.Catalogue", "seed": 3, "train": 2, "test": 0}


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Surface samples of the catalogue with noise of known size, and what describes them."""
    items = Catalogue(seed=3, train=2, test=0).items()
    meshes = [item.load() for item in items]
    recipe = SurfaceSamples(points=256)
    clouds = [
        recipe.make(mesh, item.id, 5, None).arrays["points"]
        for mesh, item in zip(meshes, items, strict=True)
    ]
    folder = tmp_path_factory.mktemp("generated")
    placing = {"_target_": "qs3.meshes.placement.UnitCube"}
    write_pointset(
        folder,
        name="generated",
        classes=fixtures.CLASSES,
        arrays={"points": clouds},
        rows=[
            ManifestRow(item.id, item.cls, item.split, mesh_sha256=mesh.sha256)
            for item, mesh in zip(items, meshes, strict=True)
        ],
        meta={"settings": {"seed": 5, "recipe": {"placing": placing}, "meshes": CATALOGUE}},
    )
    return folder


def test_samples_of_a_surface_lie_on_it(generated):
    opened = open_named(str(generated), {})
    surfaces, reason = surfaces_of(dict(opened.data.meta))
    assert surfaces is not None
    assert not reason
    for row, cloud in zip(opened.kept[::4], opened.data.points[::4], strict=True):
        mesh = surfaces.mesh(row)
        assert mesh is not None
        assert distance_to_mesh(cloud, mesh, np.random.default_rng(0)).max() < 1e-4
        wrong = UnitCube().place(mesh, object_rng(6, row.id, 0))  # another yaw
        assert distance_to_mesh(cloud, wrong, np.random.default_rng(0)).mean() > 1e-3


def test_inspect_takes_no_meshes_of_which_it_measures_nothing(generated, tmp_path, capsys):
    assert main(["inspect", str(generated), f"meshes={tmp_path}"]) == 1
    assert "meshes" in capsys.readouterr().err


def test_only_known_targets_are_made_from_a_store():
    evil = {"seed": 0, "recipe": {"placing": {"_target_": "os.system", "command": "false"}}}
    assert surfaces_of({"settings": {**evil, "meshes": CATALOGUE}})[0] is None
    assert surfaces_of({})[0] is None


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
    assert gap.nearest_neighbour(a, b) == own / 60
    assert gap.nearest_neighbour(a, a + 9) == 1


def test_priors_of_sets_with_other_classes(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(4, 8, 3))
    ids = ["a/0", "a/1", "b/2", "b/3"]
    a = store(tmp_path / "a", clouds, ids, ["train"] * 4)
    b = store(tmp_path / "b", clouds, [i.replace("b", "c") for i in ids], ["train"] * 4, ("a", "c"))
    found = gap.priors(a, b)
    assert found["by_class"] == {"a": [0.5, 0.5], "b": [0.5, 0], "c": [0, 0.5]}
    assert found["total_variation"] == pytest.approx(0.5)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    for name in ("modelnet10_arrays", "kinectsim10"):
        fixtures.write_domain(name, folder)
    return folder


def test_inspect_says_and_saves(data_dir, tmp_path, capsys):
    words = ["inspect", "domain=modelnet10_arrays", f"paths.data_dir={data_dir}", f"out={tmp_path}"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "60 clouds of 1024 points" in said
    made_of = "arrays of modelnet10_points.npz"
    assert f"made of: {made_of}\n" in said
    facts = json.loads((tmp_path / "inspection.json").read_text())
    assert facts["made_of"] == made_of
    assert facts["counts"]["splits"]["train"]["by_class"]["chair"] == 4
    assert set(facts["gravity"]["by_class"]) == set(fixtures.CLASSES)
    assert (tmp_path / "clouds.png").read_bytes().startswith(b"\x89PNG")
    assert "50 of 60 clouds of" in (tmp_path / "clouds.html").read_text()


def test_compare_says_and_saves(data_dir, tmp_path, capsys):
    words = ["compare", "modelnet10_arrays", f"{data_dir}/kinectsim10"]
    words += [f"a.paths.data_dir={data_dir}", "b.variant=points_clean", f"out={tmp_path}"]
    assert main(words) == 0
    assert "Told apart" in capsys.readouterr().out
    facts = json.loads((tmp_path / "comparison.json").read_text())
    assert facts["prior"]["total_variation"] == 0
    assert 0 <= facts["told_apart"]["density"] <= 1
    assert (tmp_path / "comparison.md").read_text().startswith("# A = ModelNet10")


def test_both_say_what_datasets_are_made_of(tmp_path, capsys):
    """A store by its folder too, where no domain's config knows more than its meta.yaml."""
    scans = MadeOf(objects="meshes of cad10", sensor="kinect_v1", views=1, without="lamp")
    samples = MadeOf(objects="embedded catalogue", sensor="surface samples")
    clouds = np.random.default_rng(0).normal(size=(4, 64, 3))
    ids = ["a/0", "a/1", "b/0", "b/1"]
    for name, made in (("one", scans), ("other", samples)):
        store(tmp_path / name, clouds, ids, ["train"] * 4, **made.meta)
    assert main(["inspect", f"{tmp_path}/one", f"out={tmp_path / 'i'}"]) == 0
    told = "meshes of cad10, kinect_v1, 1 view, without lamp"
    assert f"made of: {told}\n" in capsys.readouterr().out
    assert json.loads((tmp_path / "i/inspection.json").read_text())["made_of"] == told
    assert main(["compare", f"{tmp_path}/one", f"{tmp_path}/other", f"out={tmp_path / 'c'}"]) == 0
    text = (tmp_path / "c/comparison.md").read_text()
    assert f"A is made of: {told}.\n" in text
    assert "B is made of: embedded catalogue, surface samples.\n" in text
    assert text.split("##")[0] in capsys.readouterr().out
    facts = json.loads((tmp_path / "c/comparison.json").read_text())
    assert (facts["made_of_a"], facts["made_of_b"]) == (told, str(samples))


@pytest.mark.parametrize("measured", [64, 50])
def test_repeated_points_are_told_where_there_are_any(measured, tmp_path, capsys):
    clouds = np.random.default_rng(0).normal(size=(2, 64, 3)).astype(np.float32)
    rows = [
        ManifestRow(f"a/{i}", "a", "train", valid_points=n) for i, n in enumerate((80, measured))
    ]
    folder = tmp_path / "s"
    write_pointset(folder, name="s", classes=("a",), arrays={"points": clouds}, rows=rows, meta={})
    assert main(["inspect", str(folder), f"out={tmp_path / 'i'}", "sheets=0"]) == 0
    told = "; 1 cloud has too few: some are repeated" * (measured < 64)
    assert f"(median), at least {measured}{told}\n" in capsys.readouterr().out


def test_over_the_floor():
    """A board of 60 x 40 x 4 cm, leaning by 30 degrees, and a box 50 cm high on the floor."""
    rng = np.random.default_rng(0)
    board = rng.uniform(-0.5, 0.5, (20_000, 3)) * [0.6, 0.4, 0.04]
    tilt = np.deg2rad(60)
    c, s = np.cos(tilt), np.sin(tilt)
    board = board @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + [3, 2, -0.4]
    box = rng.uniform(-0.5, 0.5, (20_000, 3)) * [0.6, 0.4, 0.5] + np.array([0, 0, -1.0])
    facts = gap.over_the_floor([board, box, box], floor_m=-1.25)
    assert facts["plates"] == pytest.approx(1 / 3)
    assert facts["low"][1:] == pytest.approx([0.01, (0.01 + board_low(0.4, s)) / 2], abs=0.01)
    assert facts["high"][1] == pytest.approx(0.49, abs=0.005)
    assert facts["thin"][1] == pytest.approx(0.36, abs=0.01)
    assert gap.over_the_floor([board], -1.25)["thin"] == pytest.approx([0.036] * 3, abs=0.002)


def board_low(side, sine):
    """Over the floor, 2 % of a leaning board up: its middle is at 0.85 m."""
    return 0.85 - 0.96 * side * sine / 2


@pytest.mark.slow
def test_heights_are_compared_where_both_know_their_floor(data_dir, tmp_path, capsys):
    words = ["compare", "kinectsim10", "kinectsim10", f"paths.data_dir={data_dir}"]
    assert main([*words, f"out={tmp_path / 'a'}"]) == 0
    assert "## Over the floor" not in capsys.readouterr().out
    words += ["a.floor_m=0", "b.floor_m=-0.5", f"out={tmp_path / 'b'}"]
    assert main(words) == 0
    assert "## Over the floor" in capsys.readouterr().out
    facts = json.loads((tmp_path / "b" / "comparison.json").read_text())
    for cls, of in facts["floor_a"].items():
        assert facts["floor_b"][cls]["low"] == pytest.approx([z + 0.5 for z in of["low"]])
        assert facts["floor_b"][cls]["plates"] == of["plates"]


def test_one_domain_against_itself_has_no_gap(data_dir):
    opened = open_named(f"{data_dir}/kinectsim10", {})
    facts = compare(opened, opened, Bounds())
    assert facts["surface_a"]["truth"] == "clean twin"
    assert facts["prior"]["total_variation"] == 0
    assert facts["told_apart"]["all"] < 0.5  # the twin in the other set is the nearest
    assert facts["cloud_a"] == facts["cloud_b"]
    assert facts["within"] == WITHIN


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["inspect", "domain=nothing10"], "unknown; there are"),
        (["inspect", "nothing10"], "unknown; there are"),
        (["inspect", "domain=modelnet10", "variantt=points"], "variantt"),
        (["inspect", "domain=modelnet10", "paths.data_dir=/nowhere"], "is not there"),
        (["compare", "modelnet10"], "two domains"),
        (["inspect", "domain=/nowhere/at/all"], "no dataset folder"),
    ],
)
def test_mistakes_are_told(words, message, capsys):
    assert main(words) == 1
    assert message in capsys.readouterr().err


def test_unknown_keys_of_a_folder(data_dir):
    with pytest.raises(ConfigError, match="takes variant= only"):
        open_named(f"{data_dir}/kinectsim10", {"path": "x"})
