"""The height axis agrees across domains for each class.

A domain whose importer forgot a rotation costs a net tens of points of accuracy. Nothing here is
told which way is up in the data: it is judged by the shape, against objects that stand upright.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qs3.catalogue import Catalogue
from qs3.classes import CLASSES
from qs3.datasets.importers import NamedArrays, NpyTree, PointDAH5, XyzTree
from qs3.geometry.sampling import surface_sample
from qs3.report.inspection.gravity import (
    UPS,
    UpModel,
    catalogue_model,
    judge_set,
    turned,
)
from qs3.report.inspection.measure import Bounds, inspect
from qs3.report.inspection.open_dataset import open_named
from qs3.report.inspection.text import of_domain
from qs3.store.store import ManifestRow, write_pointset
from tests.fixtures import published as fixtures
from tests.fixtures.frame_files import one_each, write_nyuv2
from tests.fixtures.upright import learnt, seen_from_above, upright_examples, view_examples

SHARED = Path(__file__).parents[3] / "shared" / "data" / "modelnet10_points.npz"
SYMMETRIC = {"cabinet"}  # the fixtures' is a box with a small knob: it has no sign of up
PUBLISHED = ("modelnet10", "modelnet10_arrays", "shapenet10", "scannet10", "depthscannet10")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    splits = {"train": 8, "test": 4}
    for name in PUBLISHED:
        fixtures.write_domain(name, folder, splits)
    return folder / "published"


@pytest.fixture(scope="module")
def upright():
    """What the fixtures' objects look like when they stand upright: whole, and as scans."""
    whole = {
        cls: [fixtures.cloud(cls, f"up/{i}", 1024, real=i % 2 == 1) for i in range(24)]
        for cls in CLASSES
    }
    return UpModel.fit({cls: np.stack(clouds) for cls, clouds in whole.items()})


def importers(at):
    """Every published format, as conf/domain sets it."""
    return {
        "modelnet10": NpyTree(at / "modelnet10"),
        "modelnet10_arrays": NamedArrays(at, points=1024, file="modelnet10_points.npz"),
        "shapenet10": NpyTree(at / "shapenet10", points=1024, up="y", up_z_classes=["plant"]),
        "scannet10": PointDAH5(at / "scannet10"),
        "scannet10, mirrored": PointDAH5(at / "scannet10", undo_mirror=False),
        "depthscannet10": XyzTree(at / "depthscannet10"),
    }


def verdicts(importer, model):
    clouds, rows = importer.read(CLASSES)
    labels = np.array([CLASSES.index(row.cls) for row in rows])
    return {v.cls: v for v in judge_set(np.stack(clouds), labels, CLASSES, model)}


def test_every_published_format_stands_on_z(published, upright):
    for name, importer in importers(published).items():
        found = verdicts(importer, upright)
        assert set(found) == set(CLASSES)
        assert all(v.up[1] == "z" and not v.contradicts() for v in found.values()), name
        assert {v.up for cls, v in found.items() if cls not in SYMMETRIC} == {"+z"}, name


@pytest.mark.parametrize(
    ("forgotten", "wrong", "is_up"),
    [
        (lambda at: NpyTree(at / "shapenet10", points=1024), set(CLASSES) - {"plant"}, "+y"),
        (lambda at: NpyTree(at / "shapenet10", points=1024, up="y"), {"plant"}, "-y"),
        (lambda at: _NoTurn(at / "scannet10"), set(CLASSES), "+y"),
    ],
    ids=["shapenet10 without up=y", "its plants turned too", "scannet10 not turned"],
)
def test_a_forgotten_rotation_is_found(published, upright, forgotten, wrong, is_up):
    """The negative control: the same check, and an importer that does not turn."""
    found = verdicts(forgotten(published), upright)
    assert {cls for cls, v in found.items() if v.up[1] != "z"} == wrong
    assert {found[cls].up for cls in wrong - SYMMETRIC} == {is_up}
    assert {cls for cls, v in found.items() if v.contradicts()} == wrong


class _NoTurn(PointDAH5):
    def turn(self, cloud, cls):
        return cloud


def check_upright(found):
    """Every class along z; the sign wherever the shape tells it, for eight classes at least."""
    for v in found:
        assert not v.contradicts(), v
        assert v.up[1] == "z", v
    assert sum(v.axis_sure and v.sign_sure for v in found) >= 8


def test_the_embedded_catalogue_stands_on_z():
    """Surface samples as `domain=modelnet10` makes them."""
    rng = np.random.default_rng(0)
    items = Catalogue(seed=0, train=16, test=0).items()
    meshes = [item.load() for item in items]
    points = np.stack([surface_sample(m.vertices, m.faces, 512, rng) for m in meshes])
    labels = np.array([CLASSES.index(item.cls) for item in items])
    check_upright(judge_set(points, labels, CLASSES))


@pytest.mark.skipif(not SHARED.is_file(), reason="../shared/data/modelnet10_points.npz is absent")
def test_the_real_modelnet10_stands_on_z():
    with np.load(SHARED, allow_pickle=False) as file:
        points, cls = file["points"], file["cls"]
    labels = np.array([CLASSES.index({"night_stand": "cabinet"}.get(c, c)) for c in cls.tolist()])
    found = judge_set(points, labels, CLASSES)
    check_upright(found)
    turned = judge_set(points[..., [0, 2, 1]] * [1, -1, 1], labels, CLASSES)
    assert sum(v.contradicts() for v in turned) >= 8
    assert all(v.up[1] == "y" for v in turned)


THREE = ("chair", "table", "lamp")


@pytest.fixture(scope="module")
def some():
    """A model of three classes of the catalogue, and other objects of them."""
    model = UpModel.fit({cls: upright_examples(cls, 20) for cls in THREE})
    return model, {cls: upright_examples(cls, 6, seed=11) for cls in THREE}


@pytest.mark.parametrize("up", range(6))
def test_each_direction_is_found(some, up):
    """Turned clouds of the catalogue: the verdict turns with them."""
    model, clouds = some
    axis, sign = "xyz".index(UPS[up][1]), 1 if UPS[up][0] == "+" else -1
    matrix = np.zeros((3, 3))
    matrix[axis, 2] = sign
    matrix[(axis + 1) % 3, 0] = 1
    matrix[(axis + 2) % 3, 1] = sign
    assert np.linalg.det(matrix) == pytest.approx(1)
    for cls in THREE:
        verdict = model.judge(clouds[cls] @ matrix.T, cls)
        assert (verdict.up, verdict.axis_sure, verdict.sign_sure) == (UPS[up], True, True)


def turned_each(clouds, rng):
    return np.stack([turned(cloud, rng.uniform(0, 2 * np.pi)) for cloud in clouds])


@pytest.mark.parametrize("scans", [False, True], ids=["whole", "seen from above"])
@pytest.mark.parametrize("lie", [False, True], ids=["upright", "lying"])
def test_objects_that_lie_are_found_though_each_is_turned_by_another_angle(scans, lie):
    """What a scan of meshes with y up looks like: no axis is common to the clouds."""
    rng = np.random.default_rng(0)
    for cls in THREE:
        items = Catalogue(seed=23, train=16, test=0, classes=(cls,)).items()
        meshes = [item.load() for item in items]
        clouds = np.stack([surface_sample(m.vertices, m.faces, 2048, rng) for m in meshes])
        clouds = turned_each(clouds[..., [0, 2, 1]] * [1, 1, -1] if lie else clouds, rng)
        if scans:
            clouds = np.stack([seen_from_above(cloud, rng)[:512] for cloud in clouds])
        verdict = catalogue_model().judge(clouds, cls)
        assert (verdict.lies, verdict.stands) == (lie, not lie), verdict
        assert (verdict.contradicts(), verdict.confirms()) == (lie, not lie), verdict


def test_a_shape_alike_on_all_sides_tells_nothing():
    """Balls called chairs say nothing, neither for z nor against it."""
    balls = np.random.default_rng(0).normal(size=(12, 512, 3))
    balls /= np.linalg.norm(balls, axis=2, keepdims=True)
    verdict = catalogue_model().judge(balls, "chair")
    assert not any((verdict.axis_sure, verdict.stands, verdict.confirms()))


@pytest.fixture(scope="module")
def single_views(tmp_path_factory):
    """Objects of six classes, cut from frames of rooms of boxes."""
    folder = tmp_path_factory.mktemp("frames")
    shown = {"bookshelf", "chair", "sofa"}
    shots = [shot for shot in one_each({"train": 6}) if shot.things[0].name in shown]
    write_nyuv2(folder / "published" / "nyuv2", shots)
    return open_named("nyuv2", {"paths.data_dir": str(folder)})


def test_single_views_that_stand_are_no_alarm(single_views):
    """To a model of fused scans those of which only the front was seen seem to lie."""
    found = inspect(single_views, Bounds(sample=1))["gravity"]
    assert found["single_views"] is True
    assert found["contradicting"] == []
    assert len(found["confirming"]) >= 4
    data = single_views.data
    assert any(v.contradicts() for v in judge_set(data.points, data.labels, CLASSES))


def test_an_axis_that_single_views_have_in_common_is_found(single_views):
    """Also of the kind that is learnt from; each turned by an angle of its own, nothing is said."""
    data, model = single_views.data, catalogue_model(views=True)
    found = judge_set(data.points[..., [0, 2, 1]] * [1, 1, -1], data.labels, CLASSES, model)
    assert sum(v.contradicts() and v.up[1] == "y" for v in found) >= 4
    rng = np.random.default_rng(0)
    for cls in THREE:
        views = view_examples(cls, 4, seed=23)
        lying = views[..., [0, 2, 1]] * [1, 1, -1]
        assert model.judge(views, cls).confirms()
        assert model.judge(lying, cls).contradicts()
        unknown = model.judge(turned_each(lying, rng), cls)
        assert (unknown.lies, unknown.confirms()) == (False, False), unknown


def test_a_warning_says_where_nobody_knows_how_many_views_there_are(tmp_path):
    """Clouds of one's own: their files do not tell."""
    rows, clouds = [], []
    for i, cloud in enumerate(upright_examples("chair", 3)):
        rows.append(ManifestRow(f"chair/{i}", "chair", "train"))
        clouds.append(cloud[:, [0, 2, 1]])
    made = {"name": "s", "classes": CLASSES, "arrays": {"points": clouds}, "meta": {}}
    write_pointset(tmp_path / "none", rows=rows, **made)
    whole = [dataclasses.replace(row, views=0) for row in rows]
    write_pointset(tmp_path / "whole", rows=whole, **made)
    for name, unknown in (("none", True), ("whole", False)):
        facts = inspect(open_named(str(tmp_path / name), {}), Bounds(sample=1))
        assert facts["gravity"]["contradicting"] == ["chair"]
        assert ("can be a false alarm" in of_domain(facts)) is unknown


@pytest.mark.parametrize(("stands", "evidence"), [(True, "clear"), (False, "weak")])
def test_the_table_says_no_more_than_the_verdict(tmp_path, stands, evidence):
    """Two clouds can be sure of z and its sign, and no better on it than on their sides."""
    rows = [ManifestRow(f"chair/{i}", "chair", "train") for i in range(2)]
    clouds = upright_examples("chair", 2)[:2]
    made = {"name": "s", "classes": CLASSES, "arrays": {"points": clouds}}
    write_pointset(tmp_path / "s", rows=rows, meta={}, **made)
    facts = inspect(open_named(str(tmp_path / "s"), {}), Bounds(sample=1))
    sure = {"up": "+z", "axis_sure": True, "sign_sure": True, "stands": stands, "lies": False}
    facts["gravity"]["by_class"]["chair"] |= sure
    facts["gravity"] |= {"contradicting": [], "confirming": ["chair"] * stands}
    text = of_domain(facts)
    ends = [line.split()[-1] for line in text.splitlines() if line.startswith("chair ")]
    assert evidence in ends
    assert {"clear", "weak"} & {*ends} == {evidence}
    assert ("z is up, by the shapes of chair" in text) is stands


@pytest.mark.parametrize("views", [False, True])
def test_the_model_on_disk_is_what_is_learnt(views):
    shipped, again = catalogue_model(views), learnt("bathtub", views)
    for name, values in again.items():
        np.testing.assert_allclose(getattr(shipped, name)["bathtub"], values, rtol=2e-4, atol=1e-6)
