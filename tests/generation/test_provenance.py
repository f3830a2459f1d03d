"""Provenance and views: they tell the truth about the points, and change none of them."""

import cv2
import numpy as np
import pytest
import trimesh

from qs3.generation.command import generate
from qs3.generation.kept import (
    NO_INCIDENCE_DEG,
    NO_RESIDUAL_M,
    PROVENANCE,
)
from qs3.sensors.optics.visibility import Reason
from tests.generation.generating import config

KEPT = ["provenance=true", "keep_views=true", "tracking=drifting", "scene=room"]


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """One object a split."""
    root = tmp_path_factory.mktemp("meshes")
    for split, solid in (
        ("train", trimesh.creation.box((0.5, 0.5, 0.9))),
        ("test", trimesh.creation.cylinder(0.7, 0.7)),
    ):
        (root / "table" / split).mkdir(parents=True)
        solid.export(root / "table" / split / "table ä%2F_0.ply")
    return root


@pytest.fixture(scope="module")
def kept(meshes, tmp_path_factory):
    data_dir = tmp_path_factory.mktemp("kept")
    pointset = generate(config(data_dir, meshes, "classes=[table]", "workers=1", *KEPT))
    return data_dir / "specklenet10", pointset


def views_of(folder, name):
    paths = sorted((folder / "views" / name).glob("view_*.npz"))
    assert paths
    return [dict(np.load(path)) for path in paths]


def test_every_point_is_its_pixel_at_the_measured_depth(kept):
    folder, pointset = kept
    table = np.load(folder / "provenance.npy")
    assert pointset.meta["tables"] == {"provenance": list(PROVENANCE)}
    assert table.shape == (*pointset.points.shape[:2], 5)
    for cloud, rows, name in zip(pointset.points, table, pointset.ids, strict=True):
        views = views_of(folder, name)
        assert set(np.unique(rows[:, 0])) == set(range(len(views)))
        for i, view in enumerate(views):
            mine = rows[:, 0] == i
            u, v, residual, angle = rows[mine, 1:].T
            left, top, step = view["grid_px"]
            col, row = (u - left) / step, (v - top) / step
            np.testing.assert_array_equal(col, np.round(col))
            col, row = col.astype(int), row.astype(int)
            z = view["depth_m"][row, col].astype(float)
            assert np.isfinite(z).all()
            assert (view["reason"][row, col] == Reason.OK).all()
            ray = ((np.stack([u, v]).T - view["centre_px"]) / view["focal_px"]).T
            local = np.concatenate([ray * z, z[None]]).T
            pose = view["world_from_camera_believed"]
            np.testing.assert_allclose(cloud[mine], local @ pose[:3, :3].T + pose[:3, 3], atol=1e-5)
            clean = view["clean_m"][row, col]
            hit = np.isfinite(clean)
            np.testing.assert_allclose(residual[hit], (z - clean)[hit], atol=1e-6)
            assert (residual[~hit] == NO_RESIDUAL_M).all()
            assert (angle[~hit] == NO_INCIDENCE_DEG).all()
            expected = np.rad2deg(np.arccos(view["cosine"][row, col][hit]))
            np.testing.assert_allclose(angle[hit], expected, atol=0.1)
            assert (angle[hit] >= 0).all()
            assert (angle[hit] <= 90).all()


def test_kept_views_have_the_drift_and_a_picture_of_four_panels(kept):
    folder, pointset = kept
    first, second = views_of(folder, pointset.ids[0])
    np.testing.assert_allclose(first["world_from_camera"], first["world_from_camera_believed"])
    moved = second["world_from_camera"][:3, 3] - second["world_from_camera_believed"][:3, 3]
    assert 0.001 < np.linalg.norm(moved) < 0.1
    path = folder / "views" / pointset.ids[0] / "view_0.png"
    picture, width = cv2.imread(str(path)), first["image_left"].shape[1]
    assert picture.shape[0] >= 300
    assert picture.shape[1] > 3.5 * width * (picture.shape[0] - 22) / first["image_left"].shape[0]
    assert picture.std() > 20


def test_what_is_kept_changes_no_point(kept, meshes, tmp_path):
    folder, pointset = kept
    plain = generate(config(tmp_path, meshes, "classes=[table]", "workers=0", *KEPT[2:]))
    assert plain.sha256 == pointset.sha256
    bare = tmp_path / "specklenet10"
    for name in ("points.npy", "points_clean.npy", "manifest.csv"):
        assert (bare / name).read_bytes() == (folder / name).read_bytes()
    assert not (bare / "views").exists()
    assert not (bare / "provenance.npy").exists()
