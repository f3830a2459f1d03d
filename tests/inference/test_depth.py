"""`qs3 predict` and `predict_depth` of depth images."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import qs3
from qs3.datasets.depth_images import Pinhole
from qs3.datasets.pointed import point_out
from qs3.errors import ConfigError, DataError
from qs3.inference.model_file import read_result, write_result
from tests.fixtures.frame_files import SMALL, Shot, Thing, kinect
from tests.inference.conftest import predict, probabilities, table

SHOT = Shot(
    [
        Thing("ball", -0.6, 2.4, 20, boxes=((0, 0, 0.4, 0.7, 0.7, 0.7),)),
        Thing("rod", 0.7, 2.6, 25, boxes=((0, 0, 0.5, 0.2, 0.2, 1.0),)),
    ],
    pitch_deg=14,
    roll_deg=3,
    **SMALL,
)
CAMERA = ",".join(map(str, SHOT.camera))
UP = "up=" + ",".join(map(str, SHOT.up_in_camera))


def seen() -> tuple[np.ndarray, np.ndarray]:
    """Depth in whole millimetres, and the number of the thing that each pixel shows."""
    depth, shown = SHOT.render()
    return np.rint(kinect(depth, 1) * 1000).astype(np.uint16), np.maximum(shown + 1, 0)


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return path


@pytest.fixture
def frame(tmp_path) -> Path:
    """A folder with depth.png and mask.png."""
    depth, mask = seen()
    save(tmp_path / "depth.png", depth)
    save(tmp_path / "mask.png", mask.astype(np.uint8))
    return tmp_path


@pytest.fixture
def words(frame) -> list[str]:
    return [f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}", UP]


def test_each_object_of_a_mask_gets_the_prediction_for_its_cloud(run, frame, words):
    assert predict(run, frame / "said.csv", *words) == 0
    rows = table(frame / "said.csv")
    assert [row["file"] for row in rows] == ["depth.png[1]", "depth.png[2]"]
    depth, mask = seen()
    objects = point_out(depth / 1000, Pinhole(*SHOT.camera), mask=mask, up=SHOT.up_in_camera)
    predictor = qs3.load(run)
    expected = predictor([one.piece.points_m for one in objects])
    for row, one, each in zip(rows, objects, expected, strict=True):
        np.testing.assert_allclose(probabilities(row), each, atol=1e-6)
        assert (row["status"], row["tier"], row["up"]) == ("ok", "clean", "given")
        assert int(row["points"]) == len(one.piece.points_m)
        assert int(row["dropped"]) == one.without_depth
    page = (frame / "said.html").read_text()
    assert page.count('<img alt="cloud"') == page.count('<img alt="depth image"') == 2
    fx, fy, cx, cy = SHOT.camera
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    hidden = np.ma.masked_array(depth / 1000, mask=depth == 0)
    in_python = predictor.predict_depth(hidden, matrix, mask=mask, up=SHOT.up_in_camera)
    np.testing.assert_allclose([one.probabilities for one in in_python], expected, atol=1e-6)
    assert [one.cls for one in in_python] == [row["class"] for row in rows]
    assert [one.confidence for one in in_python] == pytest.approx(expected.max(axis=1))


def test_what_would_be_silently_wrong_is_refused(run, frame):
    depth, mask = seen()
    predictor = qs3.load(run)
    for image, camera in (
        (depth.astype(float), SHOT.camera),  # millimetres
        (depth, SHOT.camera),
        (depth / 1000, SHOT.camera[:3]),
        (depth / 1000, [5 * value for value in SHOT.camera]),
    ):
        with pytest.raises(DataError):
            predictor.predict_depth(image, camera, mask=mask)
    with pytest.raises(ConfigError):
        predictor.predict_depth(depth / 1000, SHOT.camera, mask=mask, camera_height=125)


def test_the_camera_s_height_is_for_nets_that_know_heights(high_net, frame, words):
    depth, mask = seen()
    predictor, found = qs3.load(high_net), []
    for height in (None, 1.25, 0.4):
        more = () if height is None else (f"camera_height={height}",)
        assert predict(high_net, frame / "said.csv", *words, "page=false", *more) == 0
        found.append([probabilities(row) for row in table(frame / "said.csv")])
        objects = predictor.predict_depth(
            depth / 1000, SHOT.camera, mask=mask, up=SHOT.up_in_camera, camera_height=height
        )
        np.testing.assert_allclose([one.probabilities for one in objects], found[-1], atol=1e-6)
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(np.subtract(found[0], found[2])).max() > 1e-3
    # A target whose clouds stand on z = 0 has no camera to take the height of.
    write_result(high_net, replace(predictor.result, floor_m=0.0))
    assert predict(high_net, frame / "none.csv", *words) == 1
    with pytest.raises(ConfigError):
        qs3.load(high_net).predict_depth(depth / 1000, SHOT.camera, mask=mask)


def test_the_page_shows_upright_sizes_and_heights(run, high_net, frame, words):
    """Whatever frame the net sees: with `gravity: none` z is the camera's axis."""
    sizes = []
    for gravity in ("z", "none"):
        write_result(frame / "net.pt", replace(read_result(run), gravity=gravity))
        assert predict(frame / "net.pt", frame / "said.csv", *words) == 0
        page = (frame / "said.html").read_text()
        found = re.findall(r"png\[(\d)\].*?<br>([\d.]+) m wide, ([\d.]+) m high", page)
        sizes.append(np.array(sorted(found), dtype=float))
    np.testing.assert_allclose(sizes[1], sizes[0], atol=0.011)
    assert sizes[0][:, 2] == pytest.approx([0.7, 1.0], abs=0.06)
    assert predict(high_net, frame / "said.csv", *words, "camera_height=1.9") == 0
    page = (frame / "said.html").read_text()
    begins = [float(m) for m in re.findall(r"high, from (-?[\d.]+) m above the floor", page)]
    stand = 1.9 - SHOT.height_m  # the rod, before a camera that hangs lower; the ball 5 cm higher
    assert sorted(begins) == pytest.approx([stand, stand + 0.05], abs=0.03)


def test_a_box_without_gravity_and_metres_in_npy(run, frame):
    depth, mask = seen()
    np.save(frame / "metres.npy", np.where(depth > 0, depth / 1000, np.nan))
    v, u = np.nonzero(mask == 2)
    box = f"{u.min() - 4},{v.min() - 4},{u.max() + 5},{v.max() + 5}"
    matrix = [SHOT.camera[0], 0, SHOT.camera[2], 0, *SHOT.camera[1::2], 0, 0, 1]
    (frame / "camera.json").write_text(json.dumps({"K": matrix}))
    words = (f"depth={frame}/metres.npy", f"box={box}", f"intrinsics={frame}/camera.json")
    assert predict(run, frame / "said.csv", *words) == 0
    (one,) = table(frame / "said.csv")
    assert one["file"] == f"metres.npy[{box}]"
    assert (one["status"], one["up"], one["tier"]) == ("ok", "planes", "clean")
    true = int(((mask == 2) & (depth > 0)).sum())
    assert 0.9 * true < int(one["points"]) <= true


def test_two_folders_go_together_by_name_and_damage_costs_one(run, frame):
    depth, mask = seen()
    for name in ("a", "b", "c"):
        save(frame / "depths" / f"{name}.png", depth)
    (frame / "masks").mkdir()
    for name in ("a", "c"):
        np.save(frame / "masks" / f"{name}.npy", mask)
    whole = (frame / "depths" / "c.png").read_bytes()
    (frame / "depths" / "c.png").write_bytes(whole[: len(whole) // 2])
    words = (f"depth={frame}/depths", f"mask={frame}/masks", f"intrinsics={CAMERA}")
    assert predict(run, frame / "said.csv", *words, "up=-y", "page=false") == 1
    rows = table(frame / "said.csv")
    assert [row["file"] for row in rows] == ["a.png[1]", "a.png[2]", "b.png", "c.png"]
    assert [row["status"] for row in rows] == ["ok", "ok", "failed", "failed"]
    assert not (frame / "said.html").exists()


def test_nothing_measured_is_a_failed_row(run, frame, words):
    depth, mask = seen()
    save(frame / "depth.png", np.where(mask == 2, 0, depth).astype(np.uint16))
    assert predict(run, frame / "said.csv", *words) == 1
    rows = table(frame / "said.csv")
    assert [(row["status"], row["tier"]) for row in rows] == [("ok", "clean"), ("failed", "poor")]
    metres = np.where(mask == 2, 0, depth / 1000)
    (_, none) = qs3.load(run).predict_depth(metres, SHOT.camera, mask=mask)
    assert (none.cls, len(none.upright), none.probabilities) == ("", 0, None)
    words[1] = f"mask={frame}/gone.png"
    assert predict(run, frame / "said.csv", *words) == 1
