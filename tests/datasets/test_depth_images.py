"""Depth images as people have them: units, masks, intrinsics in many words."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from qs3.datasets.depth_images import (
    Intrinsics,
    Pinhole,
    check_intrinsics,
    read_depth,
    read_intrinsics,
    read_mask,
)
from qs3.errors import DataError

DEPTH = np.array([[0.0, 1.234, 2.5], [0.731, 4.0, 3.0]])


def png(path, image):
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return path


def npy(path, array):
    np.save(path, array)
    return path


def test_the_unit_of_depth_is_that_of_its_numbers(tmp_path):
    mm = np.rint(DEPTH * 1000).astype(np.uint16)
    holes = np.where(DEPTH == 0, np.nan, DEPTH)
    holes[0, 0] = -np.inf
    for path in (
        png(tmp_path / "mm.png", mm),
        npy(tmp_path / "mm.npy", mm),
        npy(tmp_path / "metres.npy", holes),
        npy(tmp_path / "fortran.npy", np.asfortranarray(DEPTH, dtype=np.float32)),
    ):
        np.testing.assert_allclose(read_depth(path), DEPTH, atol=1e-6)
    tum = png(tmp_path / "tum.png", np.rint(DEPTH * 5000).astype(np.uint16))
    np.testing.assert_allclose(read_depth(tum, 1 / 5000), DEPTH, atol=1e-4)


def test_a_camera_s_scale_of_depth_is_not_passed_over(tmp_path):
    """BOP's YCB-V: a tenth of a millimetre a unit; 0.8 m were read as 8 m."""
    tenths = png(tmp_path / "a.png", np.full((480, 640), 8000, np.uint16))
    camera = {"cx": 312.9, "cy": 241.3, "fx": 1066.7, "fy": 1067.4, "width": 640, "height": 480}
    file = tmp_path / "camera.json"
    file.write_text(json.dumps({**camera, "depth_scale": 0.1}))
    scale = read_intrinsics(str(file)).depth_scale
    assert scale == 0.1
    with pytest.raises(DataError):
        read_depth(tenths, None, scale)
    assert read_depth(tenths, 1e-4, scale).max() == pytest.approx(0.8)
    assert read_depth(npy(tmp_path / "m.npy", np.full((4, 4), 0.8)), None, scale).max() == 0.8
    for same in (1.0, float(np.float32(0.001)), 1000, None):
        file.write_text(json.dumps({"intrinsics": camera, "depth_scale": same}))
        scale = read_intrinsics(str(file)).depth_scale
        assert scale == same
        assert read_depth(tenths, None, scale).max() == 8


def test_depth_of_another_unit_or_none(tmp_path):
    for path in (
        png(tmp_path / "a.png", np.full((4, 5), 9, np.uint8)),  # a picture of depths
        npy(tmp_path / "b.npy", DEPTH * 1000),
        npy(tmp_path / "c.npy", np.full((3, 3), np.nan)),
    ):
        with pytest.raises(DataError, match=path.name):
            read_depth(path)


def test_masks_of_all_kinds(tmp_path):
    numbers = np.array([[0, 1, 300], [0, 0, 1]])
    small = np.where(numbers == 300, 255, numbers)
    for path in (
        png(tmp_path / "a.png", numbers.astype(np.uint16)),
        npy(tmp_path / "a.npy", numbers.astype(np.int32)),
    ):
        np.testing.assert_array_equal(read_mask(path), numbers)
    np.testing.assert_array_equal(read_mask(png(tmp_path / "b.png", small.astype(np.uint8))), small)
    palette = Image.fromarray(small.astype(np.uint8), "P")
    palette.putpalette([7 * i % 256 for i in range(768)])
    palette.save(tmp_path / "c.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "c.png"), small)
    Image.fromarray(small > 0).save(tmp_path / "d.png")  # one bit
    np.testing.assert_array_equal(read_mask(tmp_path / "d.png"), small > 0)
    np.testing.assert_array_equal(read_mask(npy(tmp_path / "e.npy", small > 0)), small > 0)
    for path in (
        png(tmp_path / "f.png", np.ones((3, 3, 3), np.uint8)),  # in colours
        npy(tmp_path / "g.npy", np.zeros((3, 3), int)),
        npy(tmp_path / "h.npy", np.ones((3, 3))),
        npy(tmp_path / "i.npy", np.arange(1600).reshape(40, 40)),
    ):
        with pytest.raises(DataError, match=path.name):
            read_mask(path)


MATRIX = [[525.0, 0, 319.5], [0, 526.0, 239.5], [0, 0, 1]]


FOUR = {"fx": 525, "fy": 526, "cx": 319.5, "cy": 239.5}
SIZE = {"width": 640, "height": 480}
ROWS, COLUMNS = np.ravel(MATRIX).tolist(), np.array(MATRIX).T.ravel().tolist()
ROS = {"image_width": 640, "image_height": 480, "camera_matrix": {"rows": 3, "data": ROWS}}


@pytest.mark.parametrize(
    ("content", "size", "bent"),
    [
        (FOUR, None, False),
        ({**SIZE, "fx": 525, "fy": 526, "ppx": 319.5, "ppy": 239.5, "coeffs": [0]}, SIZE, False),
        ({**SIZE, "intrinsic_matrix": COLUMNS}, SIZE, False),  # Open3D
        ({**ROS, "distortion_coefficients": {"data": [0.1, 0, 0, 0, 0]}}, SIZE, True),
        ({"K": MATRIX, "k1": 0, "p2": 0.0}, None, False),
        ({**FOUR, "k1": 0.0, "k2": 0, "p1": 0.001}, None, True),
        ({**SIZE, "D": [0.1, 0, 0, 0], "intrinsics": FOUR}, SIZE, True),  # about the numbers
        # rostopic echo camera_info, and Ctrl-C in the second message
        (f"---\nheight: 480\nwidth: 640\nD: [0.0]\nK: {ROWS}\n---\nheight: 480\nwid", SIZE, False),
        ({"extrinsic": [1], "intrinsic": {**SIZE, "intrinsic_matrix": COLUMNS}}, SIZE, False),
        ({"cam_K": ROWS, "depth_scale": 1.0}, None, False),  # BOP
        ("525 0 319.5\n0 526 239.5\n0 0 1\n", None, False),
        ("525 0 319.5 0\n0 526 239.5 0\n0 0 1 0\n0 0 0 1\n", None, False),
    ],
)
def test_intrinsics_as_drivers_and_libraries_write_them(tmp_path, content, size, bent):
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / "a.yaml").write_text(text)
    found = read_intrinsics(str(tmp_path / "a.yaml"))
    scale = 1.0 if "depth_scale" in text else None
    camera = Pinhole(525, 526, 319.5, 239.5)
    assert found == Intrinsics(camera, (640, 480) if size else None, bent, scale)
    assert read_intrinsics("525,526,319.5,239.5").camera == camera
    np.save(tmp_path / "K.npy", np.array(MATRIX))
    assert read_intrinsics(str(tmp_path / "K.npy")).camera == camera


@pytest.mark.parametrize(
    "text",
    ["fx: 5\nfy: 5\n", "1 2 3", "0 5 5 5", "1 2 3 4 5 6 7 8 9", "K: [[a, b]]", "---\n---\n"],
)  # fmt: skip
def test_what_holds_no_intrinsics(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(DataError, match=r"camera\.yaml"):
        read_intrinsics(str(tmp_path / "camera.yaml"))


@pytest.mark.parametrize(
    ("values", "size"),
    [
        ((525, 525, 640, 240), None),
        ((525, 525, 320, -3), None),
        ((1050, 1050, 639.5, 479.5), None),  # the middle, at twice the size
        ((0.9, 0.9, 320, 240), None),
        ((90_000, 525, 320, 240), None),
        ((525, 525, 320, 240), (1280, 720)),
    ],
)
def test_intrinsics_that_are_not_this_pictures_are_refused(values, size):
    depth = np.ones((480, 640))
    with pytest.raises(DataError):
        check_intrinsics(Intrinsics(Pinhole(*values), size), depth, "frame")
    good = Intrinsics(Pinhole(525, 525, 320, 240), (640, 480))
    assert check_intrinsics(good, depth, "frame") == ""
    assert "crop" in check_intrinsics(Intrinsics(Pinhole(525, 525, 160, 240)), depth, "frame")
    with pytest.raises(DataError, match="millimetres"):
        check_intrinsics(good, depth * 1000, "frame")
