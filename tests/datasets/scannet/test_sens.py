"""The reader of .sens recordings: what it reads, and that no file can hurt it."""

import os
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datasets.scannet.sens import SensFile, is_rigid
from qs3.errors import DataError
from tests.datasets.scannet.writing import IMU, LOST, Recording, intrinsics

SHAPE = (6, 8)
HEADER_BYTES = 4 + 8 + len(b"StructureSensor") + 292
FRAME_BYTES = 96


def shifted(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def recording(frames=3, **more):
    rng = np.random.default_rng(0)
    depth = [rng.integers(0, 9000, SHAPE).astype(np.uint16) for _ in range(frames)]
    poses = [shifted(i) for i in range(frames)]
    k = intrinsics(7.5, 7.25, 3.5, 2.5)
    return Recording(depth, poses, k, intrinsics(16, 15, 8, 6), (18, 14), **more)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    made = recording()
    path = tmp_path_factory.mktemp("sens") / "scene0000_00.sens"
    made.write(path)
    return made, path, path.read_bytes()


def opened(path):
    """Everything there is to read."""
    with SensFile(path) as sens:
        return [sens.depth_m(frame) for frame in range(len(sens))]


@pytest.mark.parametrize("compression", [0, 1])
def test_what_was_written_is_read(tmp_path, compression):
    made = recording(compression=compression, base_from_colour=shifted(0.5), shift=500.0)
    made.poses[1] = LOST
    made.write(tmp_path / "a.sens")
    with SensFile(tmp_path / "a.sens") as sens:
        header = sens.header
        assert (header.depth_width_px, header.depth_height_px) == SHAPE[::-1]
        assert (header.colour_width_px, header.colour_height_px) == (18, 14)
        assert header.sensor == "StructureSensor"
        np.testing.assert_array_equal(header.depth_intrinsics, made.k_depth[:3, :3])
        np.testing.assert_array_equal(header.colour_intrinsics, made.k_colour[:3, :3])
        np.testing.assert_allclose(header.colour_from_depth, shifted(-0.5))
        assert [sens.has_pose(i) for i in range(3)] == [True, False, True]
        np.testing.assert_array_equal(sens.poses[2], made.poses[2])
        for i in (2, 0, 1):  # in any order
            depth = sens.depth_m(i)
            assert depth.dtype == np.float32
            np.testing.assert_allclose(depth, made.depth[i] / 500.0, rtol=1e-6)


def test_a_frame_without_depth_is_empty_and_no_inertial_frames_are_needed(tmp_path):
    made = recording(1)
    sizes = struct.pack("<QQQQ", 0, 0, 0, 0)
    path = tmp_path / "a.sens"
    path.write_bytes(made.header() + np.eye(4, dtype="<f4").tobytes() + sizes)
    (depth,) = opened(path)
    np.testing.assert_array_equal(depth, np.zeros(SHAPE))


def test_a_file_cut_anywhere_is_an_error_that_names_the_place(good, tmp_path):
    _, _, data = good
    path = tmp_path / "cut.sens"
    for length in [*range(0, len(data) - len(IMU), 5), len(data) - len(IMU) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(DataError) as error:
            opened(path)
        place = "header" if length < HEADER_BYTES + 3 * FRAME_BYTES else "frame"
        assert f"cut.sens, {place}" in str(error.value)
        # a header that promises more frames than there can be is found out at once
    path.write_bytes(data[: len(data) - len(IMU)])
    assert len(opened(path)) == 3


@settings(max_examples=300, deadline=None)
@given(changes=st.lists(st.tuples(st.integers(0, HEADER_BYTES + 600), st.integers(0, 255)),
                        min_size=1, max_size=12))  # fmt: skip
def test_a_garbled_file_is_read_or_refused_and_nothing_else(good, tmp_path_factory, changes):
    _, _, data = good
    garbled = bytearray(data)
    for at, value in changes:
        garbled[at % len(garbled)] = value
    path = tmp_path_factory.mktemp("garbled") / "a.sens"
    path.write_bytes(garbled)
    told = None
    try:
        assert all(np.isfinite(depth).all() for depth in opened(path))
    except DataError as error:
        told = str(error)
    assert told is None or "a.sens" in told


def patched(data, offset, value, kind):
    return data[:offset] + struct.pack(kind, value) + data[offset + struct.calcsize(kind) :]


MATRICES = 4 + 8 + 15
DEPTH_COMPRESSION = MATRICES + 256 + 4
WIDTH = DEPTH_COMPRESSION + 4 + 8
FIRST = MATRICES + 292


@pytest.mark.parametrize(
    ("offset", "value", "kind", "message"),
    [
        (0, 3, "<I", "version 3, only 4"),
        (4, 2**63, "<Q", "sensor name of 9223372036854775808 bytes"),
        (MATRICES, np.nan, "<f", "colour intrinsics are not those of a camera"),
        (MATRICES + 128, -5.0, "<f", "depth intrinsics are not those of a camera"),
        (MATRICES + 64, 3.0, "<f", "colour extrinsics are not a rigid motion"),
        (MATRICES + 192, -np.inf, "<f", "depth extrinsics are not a rigid motion"),
        (DEPTH_COMPRESSION, 2, "<i", "Occipital's compression"),
        (DEPTH_COMPRESSION, -1, "<i", "unknown depth compression -1"),
        (WIDTH, 2**32 - 1, "<I", "depth image has a side of 4294967295 px"),
        (WIDTH, 0, "<I", "depth image has a side of 0 px"),
        (WIDTH, 9, "<I", "frame 0: the depth does not unpack to|frame 0: 96 bytes of depth"),
        (WIDTH + 8, 0.0, "<f", "depth shift of 0.0"),
        (WIDTH + 8, 1e-40, "<f", "depth shift of"),
        (WIDTH + 12, 2**62, "<Q", "4611686018427387904 frames cannot lie"),
        (FIRST + 80, 2**64 - 1, "<Q", r"frame 0 of 3: 18446744073709551615 bytes of colour"),
        (FIRST + 88, 2**40, "<Q", r"frame 0 of 3: \d+ bytes of colour and 1099511627776 of depth"),
    ],
)
def test_impossible_numbers_are_told(good, tmp_path, offset, value, kind, message):
    path = tmp_path / "a.sens"
    path.write_bytes(patched(good[2], offset, value, kind))
    with pytest.raises(DataError, match=message):
        opened(path)


def test_depth_that_would_unpack_to_gigabytes_is_not_unpacked(tmp_path):
    made = recording(1)
    bomb = zlib.compress(bytes(50_000_000), 9)
    made.frame = lambda index: (
        np.eye(4, dtype="<f4").tobytes() + struct.pack("<QQQQ", 0, 0, 0, len(bomb)) + bomb
    )
    made.write(tmp_path / "long.sens")
    with pytest.raises(DataError, match="bytes of depth for 8 x 6 px"):
        opened(tmp_path / "long.sens")
    short = zlib.compress(bytes(60_000), 9)  # within what 6 x 8 px may take packed
    made.frame = lambda index: (
        np.eye(4, dtype="<f4").tobytes() + struct.pack("<QQQQ", 0, 0, 0, len(short)) + short
    )
    made.write(tmp_path / "short.sens")
    assert len(short) < 160
    with pytest.raises(DataError, match="frame 0: the depth does not unpack to 96 bytes"):
        opened(tmp_path / "short.sens")


def test_a_recording_of_gigabytes_takes_the_memory_of_a_frame(tmp_path):
    """Each of 4 frames has 1 GiB of colour (a hole in the file); a whole frame is 0.6 MB."""
    depth = [np.full((480, 640), 1000 + i, np.uint16) for i in range(4)]
    k = intrinsics(577.0, 577.0, 319.5, 239.5)
    made = Recording(depth, [np.eye(4)] * 4, k, k, (640, 480))
    path = tmp_path / "large.sens"
    with open(path, "wb") as file:
        file.write(made.header())
        for image in depth:
            data = zlib.compress(image.tobytes())
            file.write(np.eye(4, dtype="<f4").tobytes())
            file.write(struct.pack("<QQQQ", 0, 0, 2**30, len(data)))
            file.seek(2**30, os.SEEK_CUR)
            file.write(data)
    assert path.stat().st_size > 4 * 2**30
    tracemalloc.start()
    try:
        with SensFile(path) as sens:
            for i in range(4):
                assert sens.depth_m(i)[100, 100] == np.float32(1.0 + i / 1000)
        assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
    finally:
        tracemalloc.stop()


def test_rigid_motions_are_told_from_others():
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    assert is_rigid(turn)
    assert is_rigid(shifted(1e6))
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    for bad in (LOST, np.zeros((4, 4)), 2 * np.eye(4), mirror, shifted(np.nan)):
        assert not is_rigid(bad)


def test_a_file_that_is_not_there_is_an_error_that_names_it(tmp_path):
    with pytest.raises(DataError, match=r"nowhere\.sens cannot be read"):
        SensFile(tmp_path / "nowhere.sens")
