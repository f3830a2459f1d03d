"""The authors' pose files: read safely, and followed exactly."""

import gzip
import io
import os
import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest

from qs3.datasets.download import unpack
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.command import generate
from qs3.generation.plan import settings
from qs3.generation.recipes import Mesh2Point
from qs3.generation.released.placement import PoseFile, ReleasedPlacing, ReleasedViews, pose_file
from qs3.generation.released.poses import read_poses
from qs3.generation.released.views import GrowingJitterViews, euler_xyz
from qs3.geometry.cameras import Camera, Intrinsics, project, rotation_xyz
from qs3.meshes.mesh import Mesh
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Body, Scene
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import composed as config
from tests.generation.released.test_pickles import Run
from tests.limits import memory_of_at_most

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
    assert table.of(ID + "~2").yaw_rad == table.of(ID).yaw_rad  # a further scan
    with pytest.raises(DataError, match=r"no pose for sofa/test/other .*it has 2, the first"):
        table.of("sofa/test/other")


def test_a_folder_reads_as_the_archive_does(poses, tmp_path):
    folder = tmp_path / "unpacked"
    with tarfile.open(poses) as tar:
        for member in tar:
            target = folder / member.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(tar.extractfile(member).read())
    a, b = read_poses(poses), read_poses(folder)
    assert a.ids == b.ids
    assert a.sha256 == b.sha256
    other = archive(tmp_path / "other.tar.gz", {NAME: npy(released(sofa(), seed=9))})
    assert read_poses(other).sha256 != a.sha256


def test_a_table_travels_to_workers_without_its_file(poses):
    recipe = Mesh2Point(SpeckleStereo(), poses=PoseFile(str(poses)))
    data = pickle.dumps(recipe)
    poses.unlink()
    back = pickle.loads(data)
    assert back.views.table is back.placing.table  # sent once
    np.testing.assert_array_equal(
        back.views.poses(RNG, None, ID), recipe.views.poses(RNG, None, ID)
    )


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
    with pytest.raises(ConfigError, match=r"views=6: the file of poses has 1 to 5"):
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
    with pytest.raises(DataError, match=r"largest side is 1\.02 m with the released scale 0\.01,"):
        placing.place(larger, RNG, ID)
    close = Mesh(sofa().vertices * 1.00001, sofa().faces)
    placing.place(close, RNG, ID)
    y_up = Mesh(sofa().vertices[:, [0, 2, 1]], sofa().faces)
    with pytest.raises(DataError, match=r"the middle of its box is at .*another origin or axis"):
        placing.place(y_up, RNG, ID)
    ReleasedPlacing(read_poses(poses), max_error=0.5).place(larger, RNG, ID)


def info(name, **attributes):
    made = tarfile.TarInfo(name)
    for key, value in attributes.items():
        setattr(made, key, value)
    return made


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ({"../sofa/test/a.npy": b"x"}, "leads out"),
        ({"/sofa/test/a.npy": b"x"}, "leads out"),
        ({"a": info("sofa/test/a.npy", type=tarfile.SYMTYPE, linkname="/etc/passwd")}, "a link"),
        ({"a": info("sofa/test/a.npy", type=tarfile.LNKTYPE, linkname="b")}, "a link"),
        ({"a": info("sofa/test/a.npy", type=tarfile.CHRTYPE)}, "device"),
        ({"sofa/test/a.npy": b"\0" * 100_000}, "100000 bytes, more than 65536"),
        ({"sofa/test/a.npy": b"nonsense"}, r"sofa/test/a\.npy is not a \.npy file"),
        ({"sofa/test/a.npy": npy(np.zeros(3))}, "not one pickled object"),
        ({"sofa/test/a.npy": npy(np.array([1, {}], dtype=object)[0])}, "not one pickled"),
        ({"sofa/a.npy": npy({})}, "class/split/name"),
        ({"horse/test/a.npy": npy({})}, "horse/test is not a class and split"),
        ({"sofa/test/a.npy": npy({})}, "obj_scale is missing"),
        ({NAME: npy(released(sofa())), "x/" + NAME: npy(released(sofa()))}, "a second file"),
        ({"readme.txt": b"x"}, "holds no class/split/name.npy"),
    ],
)
def test_archives_of_another_kind_are_refused(tmp_path, members, why):
    path = archive(tmp_path / "poses.tar.gz", members)
    with pytest.raises((DataError, MissingDataError), match=why):
        read_poses(path)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"obj_scale": np.array([1, 1, 2.0])}, "not one positive number"),
        ({"obj_scale": np.zeros(3)}, "not one positive number"),
        ({"obj_rotation": np.array([0.1, 0, 0])}, "tilted"),
        ({"obj_location": np.array([np.nan, 0, 0])}, "not finite"),
        (
            {"camera_location": [np.zeros(3) for _ in range(4)]},
            "4 camera locations and 5 rotations",
        ),
        ({"camera_location": [np.zeros(2) for _ in range(5)]}, r"has shape \(5, 2\)"),
        ({"camera_location": "abc"}, "not numeric"),
        ({"camera_lens": 35.0}, "camera_lens is 35.0; only the released 50.0"),
    ],
)
def test_odd_values_are_refused_with_the_file_and_the_key(tmp_path, change, why):
    path = archive(tmp_path / "poses.tar.gz", {NAME: npy({**released(sofa()), **change})})
    with pytest.raises(DataError, match=rf"sofa_0763\.npy.*{why}"):
        read_poses(path)


def test_a_file_that_would_run_code_is_refused(tmp_path):
    victim = tmp_path / "gone"
    value = {**released(sofa()), "obj_location": Run(os.mkdir, str(victim))}
    path = archive(tmp_path / "poses.tar.gz", {NAME: npy(value)})
    with pytest.raises(
        DataError, match=r"sofa_0763\.npy .* its pickle asks for more .* is run: posix\.mkdir"
    ):
        read_poses(path)
    assert not victim.exists()


def test_damaged_and_missing_files_are_told(tmp_path, poses):
    cut = tmp_path / "cut.tar.gz"
    cut.write_bytes(poses.read_bytes()[:-200])
    with pytest.raises(DataError, match=r"cut\.tar\.gz is not an archive that can be read"):
        read_poses(cut)
    raw = gzip.decompress(poses.read_bytes())
    at_a_member = tmp_path / "at_a_member.tar"
    at_a_member.write_bytes(raw.rstrip(b"\0").ljust(512 * -(-len(raw.rstrip(b"\0")) // 512), b"\0"))
    with pytest.raises(DataError, match=r"at_a_member\.tar is cut: its end is missing"):
        read_poses(at_a_member)
    data = bytearray(poses.read_bytes())
    data[-6] ^= 1  # of the checksum
    (tmp_path / "crc.tar.gz").write_bytes(data)
    with pytest.raises(DataError, match=r"crc\.tar\.gz is not an archive .* CRC"):
        read_poses(tmp_path / "crc.tar.gz")
    (tmp_path / "text.tar.gz").write_text("hello")
    with pytest.raises(DataError, match="is not an archive"):
        read_poses(tmp_path / "text.tar.gz")
    with pytest.raises(MissingDataError, match=r"poses= wants pose_params\.tar\.gz"):
        read_poses(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="poses must name a file"):
        pose_file("")
    assert pose_file(None) is None


def test_a_name_that_would_fill_the_memory_is_refused(tmp_path):
    """A header may say that the name of the next member has gigabytes, packed to nothing."""
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 5_000_000_000
    path = tmp_path / "name.tar.gz"
    with gzip.open(path, "wb") as file:
        file.write(info.tobuf(tarfile.GNU_FORMAT) + bytes(1 << 21))
    for read in (read_poses, lambda path: unpack(path, tmp_path / "out")):
        refused = pytest.raises(DataError, match=r"name\.tar\.gz: a name of 5000\d* bytes")
        with memory_of_at_most(1 << 28), refused:
            read(path)


def test_an_odd_camera_is_told_without_all_of_it(tmp_path):
    for lens, shown in ((["a" * 30_000] * 1000, "a list"), (np.zeros(3), "an? _Array")):
        value = {**released(sofa()), "camera_lens": lens}
        path = archive(tmp_path / "poses.tar.gz", {NAME: npy(value)})
        with pytest.raises(DataError, match=f"camera_lens is {shown}; only"):
            read_poses(path)
        read_poses.cache_clear()


def test_links_out_of_a_folder_are_refused(tmp_path):
    secret = tmp_path / "secret.npy"
    secret.write_bytes(npy(released(sofa())))
    (tmp_path / "poses/sofa/test").mkdir(parents=True)
    (tmp_path / "poses/sofa/test/a.npy").symlink_to(secret)
    with pytest.raises(DataError, match="a link that leads out"):
        read_poses(tmp_path / "poses")


def test_generate_follows_the_poses_and_records_what_has_none(poses, tmp_path):
    meshes = tmp_path / "meshes/sofa/test"
    meshes.mkdir(parents=True)
    (tmp_path / "meshes/sofa/train").mkdir()
    for name in ("test/sofa_0763", "test/sofa_0001", "train/sofa_0002"):
        sofa().to_trimesh().export(meshes.parent / f"{name}.off", digits=9)
    overrides = [
        *("domain=specklenet10", f"meshes={tmp_path / 'meshes'}", "classes=[sofa]"),
        *(f"poses={poses}", "renderer=mitsuba", "renderer.samples=1", "views=1", "workers=0"),
        *("recipe.points=256", f"paths.data_dir={tmp_path / 'data'}"),
    ]
    cfg, without = config(*overrides), config(*overrides[:3], *overrides[4:])
    pointset = generate(cfg)
    assert list(pointset.ids) == [ID]
    folder = tmp_path / "data/specklenet10"
    assert (folder / "manifest.csv").read_text().count("no pose for sofa/") == 2
    # The content of the file is in the recipe, its place is not.
    said = settings(cfg)["recipe"]["poses"]
    assert said["sha256"] == read_poses(poses).sha256
    assert str(poses) not in str(settings(cfg))
    assert "poses" not in settings(without)["recipe"]
    assert str(poses) not in (folder / "meta.yaml").read_text()
    # The cloud lies where the file puts the object.
    points = np.asarray(pointset.points[0])
    low, high = ReleasedPlacing(read_poses(poses)).place(sofa(), RNG, ID).bounds
    assert (points >= low - 0.031).all()
    assert (points <= high + 0.031).all()


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


@needs_release
def test_the_released_cameras_look_at_the_object():
    table = read_poses(RELEASED)
    poses = np.stack([table.of(name).world_from_camera for name in table.ids])
    to_object = -poses[..., :3, 3]
    distance = np.linalg.norm(to_object, axis=-1)
    cosine = np.einsum("nvi,nvi->nv", poses[..., :3, 2], to_object) / distance
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert angle[:, 0].max() < 1e-3
    assert angle.max() < 13
    assert (poses[..., 2, 1] < 0).all()  # y down in the image is down in the world
    assert distance[:, 0].min() > 3 - 1e-5
    assert distance[:, 0].max() < 5 + 1e-5
    # The origin, where the object is, is in every picture, near its middle.
    camera = Camera(Intrinsics.centred(1080, 1080, 1500.0), poses[7, 2])
    (pixel,), _ = project(np.zeros((1, 3)), camera)
    assert np.abs(pixel - 539.5).max() < 1500 * np.tan(np.radians(13))


@needs_release
def test_the_released_poses_follow_the_law_that_released_views_draws_from():
    cameras = read_poses(RELEASED).cameras
    law = GrowingJitterViews()
    moved = cameras[:, 1:] - cameras[:, :1]
    moved[..., 3:] = (moved[..., 3:] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(moved).max() <= 0.1 + 1e-6
    for i in range(1, 5):
        grown = (i + 1) / 5
        for columns, sigma in ((slice(3), law.shift_sigma_m), (slice(3, 6), law.turn_sigma_rad)):
            half = np.quantile(np.abs(moved[:, i - 1, columns]), 0.5, axis=0)
            np.testing.assert_allclose(half / (0.6745 * sigma * grown), 1, atol=0.05)
    azimuth = np.degrees(np.arctan2(cameras[:, 0, 1], cameras[:, 0, 0]))
    assert azimuth.min() >= -90.001
    assert azimuth.max() <= 90.001
    assert np.histogram(azimuth, 6, (-90, 90))[0].min() > 5039 / 6 * 0.9
