"""What `qs3 fit` refuses, and in which words: arguments, files of cameras, damaged frames."""

import os

import numpy as np
import pytest

from qs3.calibration.fit.frames import read_camera
from qs3.datasets.frames.given import read_intrinsics
from qs3.errors import ConfigError, DataError
from tests.running import main


@pytest.mark.parametrize(
    ("image", "arguments", "message"),
    [
        (np.full((60, 80), np.nan, np.float32), [], "no pixel"),
        (np.random.default_rng(0).uniform(1, 4, (200, 300)), [], "no plane was found"),
        (np.full((200, 300), 60.0), [], "unit="),
        (np.full((200, 300), 2.0), ["distances=1,2"], "distances= has 2"),
        (
            np.full((200, 300), 2.0),
            ["distances=2000"],
            "where the camera sees the wall 2.00 m away",
        ),
        (np.full((200, 300), 2.0), ["distances=nan"], "distances= says nan m for a.npy"),
        (np.full((200, 300), 2.0), ["distances=-2"], "give metres, in the order of the frames"),
        (np.full((15, 300), 2.0), [], "let it fill more of the view"),
        (np.full((200, 300), 2000.0), ["unit=m"], "half of its depths are beyond 2000 m"),
        (np.full((200, 300), 2.0), ["baseline=75"], "if these are millimetres, give 0.075"),
        (np.full((200, 300), 2.0), ["baseline=0"], "metres from camera to projector"),
        (np.full((200, 300), 2.0), ["baseline=nan"], "metres from camera to projector"),
        (np.full((200, 300), 2.0), ["intrinsics=1,2,3"], "fx,fy,cx,cy"),
        (np.zeros((5, 5, 3)), [], "not a depth image"),
        (np.full((200, 300), 2.0), ["focal=3"], "3 px with 300 px makes a field of view of 177.7°"),
        (np.full((200, 300), 2.0), ["focal=58000"], "field of view of 0.3°; give it in pixels"),
        (np.full((200, 300), 2.0), ["intrinsics=3,3,149,99"], "a field of view of 177.7°"),
    ],
)
def test_errors_say_what_to_do(image, arguments, message, tmp_path, capsys):
    np.save(tmp_path / "a.npy", image)
    given = any(word.startswith(("intrinsics=", "focal=")) for word in arguments)
    camera = [] if given else ["focal=300"]
    out = [f"out={tmp_path / 'x.yaml'}"]
    assert main(["fit", str(tmp_path / "a.npy"), *camera, *out, *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x.yaml").exists()


@pytest.mark.parametrize(
    "text",
    ["{", "[" * 100_000, "[]", '{"K": [1]}', f'{{"fx": 1, "fy": 1, "cx": 1, "cy": 1{"0" * 400}}}'],
)
def test_files_without_intrinsics_are_told(text, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"camera\.json (is not JSON|has neither)"):
        read_camera(str(path), 640, 480)


def test_cameras_of_other_words_and_of_another_resolution(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"fx": 580, "fy": 580, "ppx": 319.5, "ppy": 239.5}')
    found = read_camera(str(path), 640, 480)
    assert (found.focal_px, found.cx_px, found.cy_px) == (580, 319.5, 239.5)
    with pytest.raises(ConfigError, match="outside of the frames of 320 x 240 px"):
        read_camera(str(path), 320, 240)
    path.write_text('{"fx": 580, "fy": 580, "cx": 310, "cy": 230, "width": 848, "height": 480}')
    with pytest.raises(ConfigError, match="of pictures of 848 x 480 px, these frames have 640 x"):
        read_camera(str(path), 640, 480)
    assert read_camera(str(path), 848, 480).focal_px == 580


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {k}\n"),
        ("a.yml", "header:\n  seq: 1\nheight: 480\nwidth: 640\nK: {k}\n---\nK: [1]\n---\n"),
        ("a.yaml", "k: {k}\nd: [0, 0, 0, 0, 0]\n"),
        ("a.yml", "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  data: {k}\n"),
        ("a.json", '{{"intrinsics": {{"width": 640, "height": 480, "fx": 575, "fy": 575, '
        '"ppx": 319.5, "ppy": 239.5}}}}'),
    ],
)  # fmt: skip
def test_a_camera_as_ros_opencv_and_librealsense_write_it(name, text, tmp_path):
    """The files that `qs3 predict` takes."""
    (tmp_path / name).write_text(text.format(k="[575, 0, 319.5, 0, 575, 239.5, 0, 0, 1]"))
    found = read_camera(str(tmp_path / name), 640, 480)
    assert (found.focal_px, found.cx_px, found.cy_px) == (575, 319.5, 239.5)
    given = read_intrinsics(str(tmp_path / name)).camera
    assert (given.fx_px, given.cx_px, given.cy_px) == (575, 319.5, 239.5)
    with pytest.raises(ConfigError, match=r"of pictures of 640 x|outside of the frames"):
        read_camera(str(tmp_path / name), 320, 239)


@pytest.mark.parametrize("bent", ["[0, 0, 0]", "[0.1, -0.2, 0]"])
def test_a_distortion_that_is_not_corrected_is_said(bent, tmp_path, caplog):
    k = "[575, 0, 319.5, 0, 575, 239.5, 0, 0, 1]"
    for text in (f"K: {k}\nD: {bent}\n", f"k: {k}\ndistortion_coefficients: {{data: {bent}}}\n"):
        (tmp_path / "a.yaml").write_text(text)
        read_camera(str(tmp_path / "a.yaml"), 640, 480)
    said = "a.yaml: the lens's distortion is known and not corrected"
    assert caplog.text.count(said) == (2 if "-0.2" in bent else 0)


@pytest.mark.parametrize("text", ["a: [", "", "- 1", "intrinsics: 5", "K: {data: 5}", "\xff"])
def test_yaml_without_intrinsics_is_told(text, tmp_path):
    (tmp_path / "a.yaml").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"a\.yaml (is not|has neither)"):
        read_camera(str(tmp_path / "a.yaml"), 640, 480)


def test_a_principal_point_in_a_corner_is_said(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.full((200, 300), 2.0))
    words = ["fit", str(tmp_path / "a.npy"), f"out={tmp_path / 'x.yaml'}"]
    main([*words, "intrinsics=300,300,0,0"])
    assert "(0, 0) lies 50% of a side from the middle of the frames" in capsys.readouterr().out
    main([*words, "intrinsics=300,300,160,90"])
    assert "principal" not in capsys.readouterr().out


def test_a_camera_that_is_given_twice_and_a_preset_of_another_ending(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.full((200, 300), 2.0))
    frame, twice = str(tmp_path / "a.npy"), ["intrinsics=300,300,150,100", "focal=300"]
    assert main(["fit", frame, *twice, f"out={tmp_path / 'x.yaml'}"]) == 1
    assert "leave focal= out" in capsys.readouterr().err
    assert main(["fit", frame, "focal=300", f"out={tmp_path / 'x'}"]) == 1
    assert "must end in .yaml" in capsys.readouterr().err


def test_damaged_and_large_arrays_are_refused_by_their_headers(tmp_path, capsys):
    words = ["fit", str(tmp_path / "a.npy"), "focal=300", f"out={tmp_path / 'x.yaml'}"]
    np.save(tmp_path / "a.npy", np.full((100, 100), 2.0))
    os.truncate(tmp_path / "a.npy", 1000)
    assert main(words) == 1
    assert "1000 bytes, expected 80128 for shape (100, 100)" in capsys.readouterr().err
    np.save(tmp_path / "a.npy", np.zeros((1, 0), np.uint8))
    data = (tmp_path / "a.npy").read_bytes().replace(b"(1, 0)", b"(9000, 9000)")
    (tmp_path / "a.npy").write_bytes(data.replace(b" " * 6 + b"\n", b"\n"))
    os.truncate(tmp_path / "a.npy", 128 + 9000 * 9000)  # a hole, not on the disk
    assert main(words) == 1
    assert "has 81000000 values; at most 67108864 are read" in capsys.readouterr().err


def test_a_file_that_is_missing_and_frames_of_two_sizes(tmp_path, capsys):
    assert main(["fit", str(tmp_path / "no.npy"), "focal=300", "out=x.yaml"]) == 1
    assert "no.npy: there is no such file" in capsys.readouterr().err
    assert main(["fit", str(tmp_path), "focal=300", "out=x.yaml"]) == 1
    assert f"is a folder: name its frames, {tmp_path}/*.png" in capsys.readouterr().err
    np.save(tmp_path / "a.npy", np.full((100, 100), 2.0))
    np.save(tmp_path / "b.npy", np.full((90, 100), 2.0))
    files = [str(tmp_path / name) for name in ("a.npy", "b.npy")]
    assert main(["fit", *files, "focal=300", f"out={tmp_path / 'x.yaml'}"]) == 1
    assert "one size" in capsys.readouterr().err


def test_the_plot_replaces_no_frame_and_is_a_png(tmp_path, capsys):
    """Without plot= it has the preset's name, which may be a frame's."""
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").write_bytes(name.encode())
    frames = [str(tmp_path / "a.png"), str(tmp_path / "b.png")]
    for more in ([], [f"plot={tmp_path}/../{tmp_path.name}/b.png"]):
        out = f"out={tmp_path / 'a.yaml'}"
        assert main(["fit", *frames, "focal=300", out, *more]) == 1
        assert "png, which is a frame: give plot=FILE another name" in capsys.readouterr().err
    assert main(["fit", *frames, "focal=300", f"out={tmp_path / 'c.yaml'}", "plot=c.yaml"]) == 1
    assert "plot=c.yaml must end in .png" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "a.png": b"a",
        "b.png": b"b",
    }
