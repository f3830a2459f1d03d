"""The authors' pose files: read safely, and followed exactly."""

import io
import os
import tarfile
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.command import generate
from qs3.generation.plan import planned
from qs3.generation.released import (
    GrowingJitterViews,
    ReleasedPlacing,
    ReleasedViews,
    euler_xyz,
    pose_file,
    read_poses,
)
from qs3.geometry.cameras import Camera, Intrinsics, rotation_xyz
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Scene
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import composed as config
from tests.meshes.written import as_trimesh

RELEASED = Path(__file__).parents[4] / "shared/data/qs3_release/pose_params.tar.gz"
needs_release = pytest.mark.skipif(
    not RELEASED.is_file(), reason="the authors' pose_params.tar.gz is not in ../shared/data"
)
RNG = np.random.default_rng(0)


def sofa(scale=0.01):
    """An L of two boxes, largest side 1 / scale, off the origin."""
    seat = np.array(np.meshgrid([0, 1.0], [0, 0.5], [0, 0.3], indexing="ij")).reshape(3, 8).T
    back = np.array(np.meshgrid([0, 1.0], [0.4, 0.5], [0.3, 0.7], indexing="ij")).reshape(3, 8).T
    ends = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    sides = [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    faces = np.array([*ends, *sides])
    vertices = np.concatenate([seat, back]) / scale + [30.0, -20.0, 5.0]
    return Mesh(vertices, np.concatenate([faces, faces + 8]))


def released(mesh, seed=0, views=5):
    """The dict that the released code saved for a mesh."""
    rng = np.random.default_rng(seed)
    low, high = mesh.bounds
    scale, yaw = 1 / (high - low).max(), rng.uniform(0, 2 * np.pi)
    middle = rotation_xyz(np.array([0, 0, yaw])) @ ((low + high) / 2 * scale)
    poses = GrowingJitterViews(views).poses(rng, np.array([[-0.5] * 3, [0.5] * 3]))
    return {
        "obj_scale": np.full(3, scale),
        "obj_rotation": np.array([0.0, -0.0, yaw]),
        "obj_location": -middle,
        "camera_location": [pose[:3, 3].copy() for pose in poses],
        "camera_rotation": [euler_xyz(pose[:3, :3] @ np.diag([1, -1, -1])) for pose in poses],
        "camera_lens": 50.0,
        "camera_sensor_fit": "AUTO",
        "camera_sensor_width": 36.0,
        "camera_sensor_height": 36.0,
        "camera_shift_x": 0.0,
        "camera_shift_y": 0.0,
    }


def npy(value) -> bytes:
    file = io.BytesIO()
    np.save(file, value, allow_pickle=True)
    return file.getvalue()


def archive(path, members):
    """Members: name -> bytes, or a TarInfo of something else."""
    with tarfile.open(path, "w:gz") as tar:
        for name, content in members.items():
            info = content if isinstance(content, tarfile.TarInfo) else tarfile.TarInfo(name)
            if isinstance(content, bytes):
                info.size = len(content)
            tar.addfile(info, io.BytesIO(content) if isinstance(content, bytes) else None)
    return path


NAME = "pose_params/5_view/sofa/test/sofa_0763.npy"
ID = "sofa/test/sofa_0763"


@pytest.fixture
def poses(tmp_path):
    return archive(
        tmp_path / "poses.tar.gz",
        {
            NAME: npy(released(sofa())),
            "pose_params/5_view/night_stand/train/night_stand_0001.npy": npy(released(sofa(), 1)),
        },
    )


def test_names_are_joined_with_ours(poses):
    table = read_poses(poses)
    assert table.ids == ("cabinet/train/night_stand_0001", ID)
    assert table.views == 5
    assert table.row(ID + "~2") == table.row(ID) == 1  # a further scan
    with pytest.raises(DataError, match="sofa/test/other"):
        table.row("sofa/test/other")


def test_objects_and_cameras_stand_where_the_file_says(poses):
    mesh, value = sofa(), released(sofa())
    table = read_poses(poses)
    placed = ReleasedPlacing(table).place(mesh, RNG, ID)
    low, high = placed.bounds
    assert (high - low)[2] == pytest.approx(0.7)
    # By Blender's rule: scale, turn about z, move.
    yaw = value["obj_rotation"][2]
    x, y, z = mesh.vertices[3] * value["obj_scale"][0]
    c, s = np.cos(yaw), np.sin(yaw)
    expected = np.array([c * x - s * y, s * x + c * y, z]) + value["obj_location"]
    np.testing.assert_allclose(placed.vertices[3], expected, atol=1e-12)

    views = ReleasedViews(table, count=3).poses(RNG, placed.bounds, ID)
    assert len(views) == 3
    for i, pose in enumerate(views):
        np.testing.assert_allclose(pose[:3, 3], value["camera_location"][i])
        # Blender's camera looks along -z: the third column of its rotation, negated.
        blender = rotation_xyz(value["camera_rotation"][i])
        np.testing.assert_allclose(pose[:3, 2], -blender[:, 2], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 1], -blender[:, 1], atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1)
    with pytest.raises(ConfigError, match="views"):
        ReleasedViews(table, count=6)


@pytest.mark.parametrize("view", [0, 3])
def test_the_rendered_object_is_where_the_pose_projects_it(poses, view):
    """The middle of the silhouette's box, against the vertices projected by hand."""
    value, placed = released(sofa()), ReleasedPlacing(read_poses(poses)).place(sofa(), RNG, ID)
    pose = ReleasedViews(read_poses(poses)).poses(RNG, placed.bounds, ID)[view]
    camera = Camera(Intrinsics.centred(1080, 1080, 1500.0), pose)
    renderer = MitsubaRenderer(samples=1)
    (image,) = renderer.render(Scene((Body(placed),), None, 1.0), [camera], seed=0, geometry=[True])
    rows, cols = np.nonzero(image.label)
    # World to Blender's camera to its sensor: 36 mm over 1080 px, 50 mm away, y up.
    turn = rotation_xyz(value["camera_rotation"][view])
    local = (placed.vertices - value["camera_location"][view]) @ turn
    u = 540 + local[:, 0] / -local[:, 2] * 50 * 30 - 0.5
    v = 540 - local[:, 1] / -local[:, 2] * 50 * 30 - 0.5
    box = [cols.min(), cols.max(), rows.min(), rows.max()]
    np.testing.assert_allclose(box, [u.min(), u.max(), v.min(), v.max()], atol=1.0)


def test_another_mesh_or_unit_or_axis_is_refused(poses):
    placing = ReleasedPlacing(read_poses(poses))
    larger = Mesh(sofa().vertices * 1.02, sofa().faces)
    with pytest.raises(DataError):
        placing.place(larger, RNG, ID)
    close = Mesh(sofa().vertices * 1.00001, sofa().faces)
    placing.place(close, RNG, ID)
    y_up = Mesh(sofa().vertices[:, [0, 2, 1]], sofa().faces)
    with pytest.raises(DataError):
        placing.place(y_up, RNG, ID)


def test_generate_follows_the_poses_and_records_what_has_none(poses, tmp_path):
    meshes = tmp_path / "meshes/sofa/test"
    meshes.mkdir(parents=True)
    (tmp_path / "meshes/sofa/train").mkdir()
    for name in ("test/sofa_0763", "test/sofa_0001", "train/sofa_0002"):
        as_trimesh(sofa()).export(meshes.parent / f"{name}.off", digits=9)
    overrides = [
        *("domain=specklenet10", f"meshes={tmp_path / 'meshes'}", "classes=[sofa]"),
        *(f"poses={poses}", "renderer.samples=1", "views=1", "workers=0"),
        *("recipe.points=256", f"paths.data_dir={tmp_path / 'data'}"),
    ]
    cfg, without = config(*overrides), config(*overrides[:3], *overrides[4:])
    pointset = generate(cfg)
    assert list(pointset.ids) == [ID]
    folder = tmp_path / "data/specklenet10"
    assert (folder / "manifest.csv").read_text().count("no pose for sofa/") == 2
    # The content of the file is in the recipe, its place is not.
    said = planned(cfg)._settings()
    assert said["recipe"]["poses"]["sha256"] == read_poses(poses).sha256
    assert str(poses) not in str(said)
    assert "poses" not in planned(without)._settings()["recipe"]
    assert str(poses) not in (folder / "meta.yaml").read_text()
    # The cloud lies where the file puts the object.
    points = np.asarray(pointset.points[0])
    low, high = ReleasedPlacing(read_poses(poses)).place(sofa(), RNG, ID).bounds
    assert (points >= low - 0.031).all()
    assert (points <= high + 0.031).all()


class Run:
    """What a pickle would run."""

    def __reduce__(self):
        return os.mkdir, ("gone",)


@pytest.mark.parametrize(
    "member",
    [
        b"nonsense",
        npy({**released(sofa()), "obj_location": Run()}),
        *(
            npy({**released(sofa()), **change})
            for change in (
                {"obj_scale": np.array([1, 1, 2.0])},
                {"obj_rotation": np.array([0.1, 0, 0])},
                {"obj_location": np.array([np.nan, 0, 0])},
                {"camera_location": [np.zeros(3) for _ in range(4)]},
                {"camera_lens": 35.0},
            )
        ),
    ],
)
def test_what_is_no_pose_is_refused_by_its_name_and_runs_nothing(tmp_path, monkeypatch, member):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=r"sofa_0763\.npy"):
        read_poses(archive(tmp_path / "poses.tar.gz", {NAME: member}))
    assert not (tmp_path / "gone").exists()


def test_damaged_and_missing_files_are_refused(tmp_path, poses):
    data = poses.read_bytes()
    for damaged in (data[:-200], data[:100], b"hello"):
        (tmp_path / "cut.tar.gz").write_bytes(damaged)
        with pytest.raises(DataError, match=r"cut\.tar\.gz"):
            read_poses(tmp_path / "cut.tar.gz")
    for missing in (tmp_path / "nowhere", archive(tmp_path / "a.tar.gz", {"readme.txt": b"x"})):
        with pytest.raises(MissingDataError):
            read_poses(missing)
    assert pose_file(None) is None


@pytest.mark.slow
@needs_release
def test_all_released_poses_are_read():
    table = read_poses(RELEASED)
    assert len(table.ids) == 5039
    assert table.views == 5
    names = np.load(RELEASED.parents[1] / "modelnet10_points.npz")
    alias = {"night_stand": "cabinet"}
    wanted = {
        f"{alias.get(cls, cls)}/{split}/{name}"
        for cls, split, name in zip(names["cls"], names["split"], names["name"], strict=True)
    }
    assert set(table.ids) == wanted
