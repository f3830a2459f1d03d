"""Which clouds of a dataset are shown, and that views and residuals are those of the points."""

import dataclasses

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from qs3.catalogue import Catalogue
from qs3.generation.provenance import NO_RESIDUAL_M, PROVENANCE
from qs3.meshes.placement import UnitCube
from qs3.report.contact_sheets import drawn
from qs3.report.inspection.open_dataset import open_named
from qs3.report.inspection.viewed import chosen, part_of
from qs3.store.store import ManifestRow, write_pointset
from qs3.utils.seeding import object_rng
from tests.report.inspection.test_measures import distances


def write(folder, labels=("a", "b", "a"), tables=None, **arrays):
    rng = np.random.default_rng(1)
    rows = [ManifestRow(f"{c}/{i}", c, "train", origin=f"from {i}") for i, c in enumerate(labels)]
    clouds = rng.normal(size=(len(labels), 6, 3))
    write_pointset(
        folder, name="s", classes=("a", "b", "c"), arrays={"points": clouds, **arrays}, rows=rows,
        meta={}, tables=tables,
    )  # fmt: skip
    return open_named(str(folder), {})


@given(st.lists(st.integers(-1, 3), min_size=1, max_size=40), st.integers(1, 45))
def test_as_many_of_each_class_as_there_is_room_for(labels, most):
    data = _Labelled(np.array(labels))
    found = chosen(data, most)
    assert len({*found}) == len(found) == min(most, len(labels))
    assert found == sorted(found, key=lambda i: (labels[i], i))
    got = {k: sum(labels[i] == k for i in found) for k in {*labels}}
    for k, count in got.items():  # only who has no more has fewer than another by two
        assert count == labels.count(k) or count >= max(got.values()) - 1
    assert found == chosen(data, most)


@dataclasses.dataclass
class _Labelled:
    labels: np.ndarray

    @property
    def ids(self):
        return [f"{label}/{i}" for i, label in enumerate(self.labels)]


def test_only_ids_with_the_words():
    data = _Labelled(np.array([0, 1, 0, 1, 0]))
    assert chosen(data, 9, "0/") == [0, 2, 4]
    assert len(chosen(data, 2, "1/")) == 2
    assert chosen(data, 9, "none") == []


def test_what_is_drawn_is_not_at_even_steps():
    """Families of a catalogue take turns: at even steps all shown would be of one."""
    found = drawn(np.arange(100), 10)
    assert found == sorted({*found})
    assert len({i % 10 for i in found}) > 4
    assert drawn(np.array([5, 7]), 2) == [5, 7]


def test_provenance_gives_views_and_errors(tmp_path):
    table = np.zeros((3, 6, 5))
    table[..., 0] = np.arange(6) % 4
    table[..., 3] = [0.1, -0.2, NO_RESIDUAL_M, 0, 0.3, -0.4]
    opened = write(tmp_path, tables={"provenance": PROVENANCE}, provenance=table)
    part = part_of(opened, [2, 0], residuals=False)  # these cost nothing
    assert [one.name for one in part.shown] == ["a/2", "a/0"]
    assert [one.note for one in part.shown] == ["from 2", "from 0"]
    assert part.residual_of == "error of the depth that the sensor measured"
    for one, i in zip(part.shown, (2, 0), strict=True):
        np.testing.assert_array_equal(one.points, opened.data.points[i])
        np.testing.assert_array_equal(one.view, np.arange(6) % 4)
        np.testing.assert_allclose(one.residual, [0.1, 0.2, np.nan, 0, 0.3, 0.4], rtol=1e-6)


def test_of_the_clean_variant_no_provenance_is_shown(tmp_path):
    """It tells of the measured points."""
    table, clean = np.zeros((3, 6, 5)), np.random.default_rng(0).normal(size=(3, 6, 3))
    write(tmp_path, tables={"provenance": PROVENANCE}, provenance=table, points_clean=clean)
    part = part_of(open_named(str(tmp_path), {"variant": "points_clean"}), [0])
    assert part.shown[0].view is None
    assert part.shown[0].residual is None
    assert part.residual_of == ""


def test_without_meshes_the_clean_twin_is_the_truth(tmp_path):
    clean = np.random.default_rng(0).normal(size=(3, 6, 3))
    opened = write(tmp_path, points_clean=clean)
    seen = []
    part = part_of(opened, [0, 1, 2], advance=lambda: seen.append(1))
    assert len(seen) == 3
    assert "clean twin" in part.residual_of
    for one, twin in zip(part.shown, opened.twin.points, strict=True):
        every = np.linalg.norm(one.points[:, None] - twin[None].astype(float), axis=2)
        np.testing.assert_allclose(one.residual, every.min(axis=1))
    off = part_of(opened, [0], residuals=False)
    assert off.shown[0].residual is None
    assert off.residual_of == ""


def test_the_mesh_is_the_truth_where_it_can_be_made_again(tmp_path):
    """By every triangle; of another mesh than was scanned nothing is said."""
    items = Catalogue(seed=3, train=2, test=0, classes=("chair",)).items()
    placed = [UnitCube().place(i.load(), object_rng(5, i.id, 0), i.id) for i in items]
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(*mesh.bounds, (20, 3)) for mesh in placed]
    source = {"_target_": "qs3.catalogue.Catalogue", "seed": 3, "train": 2, "test": 0}
    write_pointset(
        tmp_path, name="s", classes=("chair",), arrays={"points": clouds},
        rows=[
            ManifestRow(items[0].id, "chair", "train", mesh_sha256=items[0].load().sha256),
            ManifestRow(items[1].id, "chair", "train", mesh_sha256="0" * 64),
        ],
        meta={"settings": {"seed": 5, "recipe": {}, "meshes": source | {"classes": ["chair"]}}},
    )  # fmt: skip
    part = part_of(open_named(str(tmp_path), {}), [0, 1])
    assert part.residual_of == "distance to the mesh"
    known, other = part.shown
    np.testing.assert_allclose(known.residual, distances(known.points, placed[0]), atol=1e-6)
    assert known.residual.max() > 0.05
    assert other.residual is None


def test_unlabelled_clouds_have_no_class(tmp_path):
    part = part_of(write(tmp_path, labels=("", "", "")), [0, 1, 2])
    assert [one.label for one in part.shown] == ["", "", ""]
    assert part.residual_of == ""
    assert part.about.startswith("3 of 3 clouds of s, made of: ")
