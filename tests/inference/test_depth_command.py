"""`qs3 predict` of depth images and of archives of objects, and the page that it makes."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import qs3
from qs3.datasets.depth_images import Pinhole
from qs3.datasets.pointed import point_out
from qs3.errors import ConfigError, DataError
from qs3.inference.model_file import read_result, write_result
from qs3.runs.metrics import read_metrics
from tests.fixtures.frame_files import Shot, Thing, kinect, write_archive
from tests.fixtures.published import CLASSES
from tests.running import main

SHOT = Shot(
    [
        Thing("ball", -0.6, 2.4, 20, boxes=((0, 0, 0.4, 0.7, 0.7, 0.7),)),
        Thing("rod", 0.7, 2.6, 25, boxes=((0, 0, 0.5, 0.2, 0.2, 1.0),)),
    ],
    pitch_deg=14,
    roll_deg=3,
)
CAMERA = ",".join(map(str, SHOT.camera))


def table(path: Path) -> list[dict[str, str]]:
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


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


def predict(run: str | Path, out: Path, *more: str) -> int:
    return main(["predict", f"ckpt={run}", f"out={out}", "threads=1", *more])


def test_each_object_of_a_mask_gets_what_the_net_says_of_its_cloud(run, frame, capsys):
    up = ",".join(map(str, SHOT.up_in_camera))
    words = (f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}")
    assert predict(run, frame / "said.csv", *words, f"up={up}") == 0
    rows = table(frame / "said.csv")
    assert [row["file"] for row in rows] == ["depth.png[1]", "depth.png[2]"]
    depth, mask = seen()
    objects = point_out(depth / 1000, Pinhole(*SHOT.camera), mask=mask, up=SHOT.up_in_camera)
    predictor = qs3.load(run)
    expected = predictor([one.piece.points_m for one in objects])
    for row, one, each in zip(rows, objects, expected, strict=True):
        found = [float(row[f"p_{name}"]) for name in predictor.classes]
        np.testing.assert_allclose(found, each, atol=1e-6)
        assert (row["status"], row["tier"], row["up"]) == ("ok", "clean", "given")
        assert int(row["points"]) == len(one.piece.points_m)
        assert int(row["dropped"]) == one.without_depth
    said = capsys.readouterr().out
    assert "2 clouds, " in said
    assert "from 1 depth image" in said
    assert f"saved {frame}/said.html" in said
    page = (frame / "said.html").read_text()
    assert page.count('<img alt="cloud"') == page.count('<img alt="depth image"') == 2
    assert "nobody knows which are right" in page
    sizes = re.findall(r"png\[(\d)\].*?<br>([\d.]+) m wide, ([\d.]+) m high", page)
    (ball, rod) = ((float(wide), float(high)) for _, wide, high in sorted(sizes))
    assert 0.7 < ball[0] < 1.05  # a side to the diagonal
    assert 0.2 < rod[0] < 0.35
    assert [ball[1], rod[1]] == pytest.approx([0.7, 1.0], abs=0.06)
    with pytest.raises(ConfigError, match="camera_height=0 is not a height"):
        predictor.predict_depth(depth / 1000, SHOT.camera, mask=mask, camera_height=0)
    with pytest.raises(DataError, match=r"beyond \d+ m; if these are millimetres, divide"):
        predictor.predict_depth(depth.astype(float), SHOT.camera, mask=mask)
    with pytest.raises(DataError, match="camera: 3 numbers; expected fx,fy,cx,cy or a 3 x 3"):
        predictor.predict_depth(depth / 1000, SHOT.camera[:3], mask=mask)
    fx, fy, cx, cy = SHOT.camera
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    in_python = predictor.predict_depth(depth / 1000, matrix, mask=mask, up=SHOT.up_in_camera)
    np.testing.assert_allclose([one.probabilities for one in in_python], expected, atol=1e-6)
    assert [one.cls for one in in_python] == [row["class"] for row in rows]
    with pytest.raises(DataError, match="expected floats"):
        predictor.predict_depth(depth, SHOT.camera, mask=mask)


def test_the_camera_s_height_is_for_nets_that_know_heights(high_net, frame, capsys):
    up = ",".join(map(str, SHOT.up_in_camera))
    words = (f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}")
    words = (*words, f"up={up}", "page=false")
    depth, mask = seen()
    predictor, found = qs3.load(high_net), []
    for height in (None, 1.25, 0.4):
        more = () if height is None else (f"camera_height={height}",)
        assert predict(high_net, frame / "said.csv", *words, *more) == 0
        told = "knows heights: the camera counts as 1.25 m above the floor (camera_height= says"
        assert (told in capsys.readouterr().out) == (height is None)
        rows = table(frame / "said.csv")
        found.append([[float(row[f"p_{name}"]) for name in predictor.classes] for row in rows])
        (frame / "said.csv").rename(frame / ("last.csv" if height == 0.4 else "first.csv"))
        objects = predictor.predict_depth(
            depth / 1000, SHOT.camera, mask=mask, up=SHOT.up_in_camera, camera_height=height
        )
        np.testing.assert_allclose([one.probabilities for one in objects], found[-1], atol=1e-6)
    # A target whose clouds stand on z = 0 has no camera to take the height of.
    write_result(high_net, replace(predictor.result, floor_m=0.0))
    assert predict(high_net, frame / "none.csv", *words) == 1
    assert "say nothing about a camera: give its height, camera_height=" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="a camera: give its height, camera_height=METRES"):
        qs3.load(high_net).predict_depth(depth / 1000, SHOT.camera, mask=mask)
    assert predict(high_net, frame / "none.csv", *words, "camera_height=1.25") == 0
    assert table(frame / "none.csv") == table(frame / "first.csv")
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(np.subtract(found[0], found[2])).max() > 1e-3


def test_the_page_says_how_high_objects_begin_if_the_net_knows_heights(run, high_net, frame):
    up = ",".join(map(str, SHOT.up_in_camera))
    words = [f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}"]
    assert predict(high_net, frame / "said.csv", *words, f"up={up}", "camera_height=1.9") == 0
    page = (frame / "said.html").read_text()
    begins = [float(m) for m in re.findall(r"high, from (-?[\d.]+) m above the floor", page)]
    stand = 1.9 - SHOT.height_m  # the rod, before a camera that hangs lower; the ball 5 cm higher
    assert sorted(begins) == pytest.approx([stand, stand + 0.05], abs=0.03)
    assert predict(run, frame / "said.csv", *words, f"up={up}") == 0
    assert "above the floor" not in (frame / "said.html").read_text()


def test_sizes_on_the_page_are_upright_whatever_frame_the_net_sees(run, frame):
    """A net of `gravity: none` sees clouds in the camera's frame, whose z is its axis."""
    up = ",".join(map(str, SHOT.up_in_camera))
    words = [f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}"]
    sizes = []
    for gravity in ("z", "none"):
        write_result(frame / "net.pt", replace(read_result(run), gravity=gravity))
        assert predict(frame / "net.pt", frame / "said.csv", *words, f"up={up}") == 0
        page = (frame / "said.html").read_text()
        found = re.findall(r"png\[(\d)\].*?<br>([\d.]+) m wide, ([\d.]+) m high", page)
        sizes.append(np.array(sorted(found), dtype=float))
    np.testing.assert_allclose(sizes[1], sizes[0], atol=0.011)


def test_a_height_that_no_net_looks_at_is_refused(run, frame, capsys):
    np.save(frame / "a.npy", np.random.default_rng(0).normal(size=(99, 3)))
    words = [f"depth={frame}/depth.png", f"mask={frame}/mask.png", f"intrinsics={CAMERA}"]
    for given in ([f"input={frame}/a.npy", "floor=0.4"], [*words, "camera_height=1.2"]):
        assert predict(run, frame / "said.csv", *given) == 1
        assert f"{given[-1].partition('=')[0]}= would have no effect" in capsys.readouterr().err
    assert not (frame / "said.csv").exists()


def test_of_nothing_predicted_nothing_is_judged(run, frame, capsys):
    words = [f"depth={frame}/depth.png", f"intrinsics={CAMERA}", "box=900,1,950,40"]
    assert predict(run, frame / "said.csv", *words) == 1
    said = capsys.readouterr().out
    assert "lies outside the image" in said
    assert "cannot be told" not in said
    assert "the classifier's data" not in said


def test_a_box_without_gravity_and_metres_in_npy(run, frame):
    depth, mask = seen()
    np.save(frame / "metres.npy", np.where(depth > 0, depth / 1000, np.nan))
    v, u = np.nonzero(mask == 2)
    box = f"{u.min() - 4},{v.min() - 4},{u.max() + 5},{v.max() + 5}"
    (frame / "camera.json").write_text(
        json.dumps({"K": [SHOT.camera[0], 0, SHOT.camera[2], 0, *SHOT.camera[1::2], 0, 0, 1]})
    )
    words = (f"depth={frame}/metres.npy", f"box={box}", f"intrinsics={frame}/camera.json")
    assert predict(run, frame / "said.json", *words) == 0
    (one,) = json.loads((frame / "said.json").read_text())["clouds"]
    assert one["file"] == f"metres.npy[{box}]"
    assert (one["status"], one["up"], one["tier"]) == ("ok", "planes", "clean")
    true = int(((mask == 2) & (depth > 0)).sum())
    assert 0.9 * true < one["points"] <= true


def test_a_list_with_a_damaged_picture_goes_on(run, frame, capsys, caplog):
    caplog.set_level("INFO", logger="qs3")
    whole = (frame / "depth.png").read_bytes()
    (frame / "broken.png").write_bytes(whole[: len(whole) // 2])
    (frame / "objects.csv").write_text(
        "depth,mask,object,box,intrinsics,label\n"
        "depth.png,mask.png,1,,,ball\n"
        "broken.png,mask.png,,,,rod\n"
        'depth.png,,,"300,90,nowhere,400",,\n'
        "depth.png,mask.png,9,,,\n"
        "gone.png,mask.png,,,,\n"
        'depth.png,mask.png,2,,"5,5,5,5",\n'
        "depth.png,mask.png,2,,,Rod\n"
    )
    out = frame / "said.csv"
    assert predict(run, out, f"depth={frame}/objects.csv", f"intrinsics={CAMERA}", "up=-y") == 1
    rows = table(out)
    assert [row["status"] for row in rows] == ["ok", *["failed"] * 5, "ok"]
    assert [row["label"] for row in rows] == ["ball", "rod", "", "", "", "", "rod"]
    reasons = [row["reason"] for row in rows[1:6]]
    for reason, words in zip(
        reasons,
        (
            "broken off",
            "row 3: box=300,90,nowhere,400",
            "no object 9",
            "not there",
            "field of view",
        ),
        strict=True,
    ):
        assert words in reason
    said = capsys.readouterr().out
    assert "5 failed:" in said
    assert "clouds: 9 of 9, " in caplog.text  # two masks of two, whose pictures are not read
    assert re.search(r"right [012] of 2 \(", said)
    page = (frame / "said.html").read_text()
    assert "Not predicted: 5" in page
    assert "broken off" in page


@pytest.mark.parametrize(
    ("words", "out"),
    [
        (["depth={at}/objects.csv", f"intrinsics={CAMERA}"], "objects.csv"),
        (["depth={at}/objects.csv", f"intrinsics={CAMERA}"], "same.csv"),  # a link to it
        (["depth={at}/depth.png", "mask={at}/mask.png", "intrinsics={at}/k.json"], "k.json"),
        (["depth={at}/depth.png", "mask={at}/mask.png", "intrinsics={at}/k.html"], "k.csv"),
        (["depth={at}/objects.csv"], "own.json"),  # of a row
    ],
)
def test_what_is_read_is_not_replaced(frame, capsys, words, out):
    lines = ("depth,mask,intrinsics", "depth.png,mask.png,own.json")
    (frame / "objects.csv").write_text("\n".join(lines))
    (frame / "same.csv").symlink_to(frame / "objects.csv")
    for name in ("k.json", "k.html", "own.json"):
        (frame / name).write_text(CAMERA)
    before = {path: path.read_bytes() for path in frame.iterdir()}
    given = [word.format(at=frame) for word in words]
    assert predict("pointnet-speckle", frame / out, *given) == 1
    assert "which is read; give another name" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in frame.iterdir()} == before


def test_two_folders_go_together_by_name(run, frame):
    depth, mask = seen()
    for name in ("a", "b"):
        save(frame / "depths" / f"{name}.png", depth)
    np.save(frame / "a.npy", mask)
    (frame / "masks").mkdir()
    (frame / "a.npy").rename(frame / "masks" / "a.npy")
    words = (f"depth={frame}/depths", f"mask={frame}/masks", f"intrinsics={CAMERA}")
    assert predict(run, frame / "said.csv", *words, "up=-y", "page=false") == 1
    rows = table(frame / "said.csv")
    assert [row["file"] for row in rows] == ["a.png[1]", "a.png[2]", "b.png"]
    assert "no mask of its name" in rows[2]["reason"]
    assert not (frame / "said.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["depth={at}/depth.png"], "takes mask=FILE"),
        (["depth={at}/depth.png", "mask={at}/mask.png"], "intrinsics=fx,fy,cx,cy of the depth"),
        (["depth={at}/depth.png", "mask={at}/mask.png", "box=1,2,3,4"], "not both"),
        (["depth={at}/depth.png", "box=1,2,3", "intrinsics=5,5,5,5"], "expected 4 numbers"),
        (["depth={at}/depth.png", "mask={at}/gone.png", "intrinsics=5,5,5,5"], "gone.png is not"),
        (["depth={at}/gone.png", "mask={at}/mask.png"], "gone.png is not there"),
        (["depth={at}", "intrinsics=5,5,5,5"], "give mask=FOLDER"),
        (["depth={at}/depths", "mask={at}/masks", "intrinsics={at}/k.yml"], "k.yml is not there"),
        (["depth={at}/depth.png", "up=z"], "up=z: expected 3 numbers"),
        (["input={at}", "mask={at}/mask.png"], "mask= is for depth images"),
        (["input={at}", "depth={at}/depth.png"], "give input=PATH for clouds, or depth="),
        (["depth={at}/depth.png", "depth_scale=5"], "depth_scale=5: metres a unit"),
        (["input={at}", "camera_height=1"], "camera_height= is for depth images"),
        (["depth={at}/depth.png", "floor=0"], "floor= is for clouds"),
        (["input={at}", "camera_height=0"], "camera_height= is for depth images"),
        (["depth={at}/depth.png", "camera_height=0"], "camera_height=0 is not a height above"),
    ],
)
def test_mistakes_are_told_in_words(run, frame, capsys, words, message):
    given = [word.format(at=frame) for word in words]
    assert predict(run, frame / "said.csv", *given) == 1
    assert message in capsys.readouterr().err
    assert not (frame / "said.csv").exists()


def test_an_archive_with_labels_shows_right_and_wrong(run, tmp_path, capsys):
    """Its classes are ten; of three of them the net's names are put in."""
    arrays = write_archive(tmp_path / "objects.npz", {"train": 4, "test": 2})
    ours = dict(zip(CLASSES, ["ball", "rod", "slab", "ball"], strict=False))
    arrays["cls"] = np.array([ours.get(cls, cls) for cls in arrays["cls"].tolist()])
    arrays["occ"][arrays["tier"] == "hard"] = 0.3
    np.savez(tmp_path / "objects.npz", **arrays)
    out = tmp_path / "said.csv"
    assert predict(run, out, f"input={tmp_path}/objects.npz", "part=adapt") == 0
    rows = table(out)
    of_part = np.flatnonzero(arrays["dev"] == "adapt")
    assert [row["file"] for row in rows] == [f"objects.npz[{i}]" for i in of_part]
    assert [row["tier"] for row in rows] == arrays["tier"][of_part].tolist()
    assert [row["label"] for row in rows] == arrays["cls"][of_part].tolist()
    for row in rows:
        assert ("30% of its outline covered" in row["caution"]) == (row["tier"] == "hard")
    judged = [row for row in rows if row["label"] in ("ball", "rod", "slab")]
    right = [row for row in judged if row["label"] == row["class"]]
    clean = [row for row in judged if row["tier"] == "clean"]
    said = capsys.readouterr().out
    assert f"right {len(right)} of {len(judged)} (" in said
    assert f"clean {sum(row in right for row in clean)} of {len(clean)} (" in said
    page = (tmp_path / "said.html").read_text()
    assert f"{len(right)} of {len(judged)} right" in page
    assert f"Wrong: {len(judged) - len(right)} " in page
    cards = re.findall(r'<div class="card wrong">.*?class="said">(\w+) (\d+)%', page)
    assert len(cards) == len(judged) - len(right) > 1
    sure = [int(percent) for _, percent in cards]
    assert sure == sorted(sure, reverse=True)
    assert "covered" in page
    assert "chair 4" in html.unescape(page)  # not a class of the net
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == len(rows)
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(pictures[0]))).convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10  # a cloud is drawn


@pytest.mark.parametrize(
    ("parts", "given", "taken", "said"),
    [
        (("adapt", "judge"), "", {"adapt"}, "part adapt of objects.npz (its parts: adapt 10, "),
        (("adapt", "judge"), "judge", {"judge"}, "part judge of "),
        (("adapt", "judge"), "all", {"adapt", "judge", "gap"}, "all objects of "),
        (("mine", "judge"), "", {"mine", "gap"}, "all but part judge of "),
        (("mine", "yours"), "", {"mine", "yours", "gap"}, "all objects of "),
        (None, "", None, ""),
        (None, "all", None, ""),
    ],
)
def test_of_an_archive_goes_what_one_chooses_on(run, tmp_path, capsys, parts, given, taken, said):
    arrays = write_archive(tmp_path / "objects.npz", {"train": 1, "test": 1}, points=64)
    if parts:
        names = dict(zip(("adapt", "judge", "gap"), (*parts, "gap"), strict=True))
        arrays["dev"] = np.array([names[part] for part in arrays["dev"].tolist()])
    else:
        del arrays["dev"]
    np.savez(tmp_path / "objects.npz", **arrays)
    words = [f"input={tmp_path}/objects.npz", "page=false", *[f"part={given}"] * bool(given)]
    assert predict(run, tmp_path / "said.csv", *words) == 0
    which = [int(row["file"][12:-1]) for row in table(tmp_path / "said.csv")]
    if taken is None:
        assert which == list(range(len(arrays["cls"])))
    else:
        assert {arrays["dev"][i] for i in which} == taken
        assert len(which) == sum(part in taken for part in arrays["dev"].tolist())
    out = capsys.readouterr().out
    assert ("taken: " in out) is bool(said)
    assert said in out


def test_page_and_text_say_what_the_net_was_trained_on(run, tmp_path, capsys):
    """Where the run's result lies beside it."""
    write_archive(tmp_path / "objects.npz", {"train": 1, "test": 1}, points=64)
    words = (f"input={tmp_path}/objects.npz", "sample=2")
    assert predict(run, tmp_path / "said.csv", *words) == 0
    trained = read_metrics(run).data_text
    assert "specklenet10 (" in trained
    assert f"the classifier's data: {trained}\n" in capsys.readouterr().out
    assert trained in html.unescape((tmp_path / "said.html").read_text())
    shutil.copy(run / "result.pt", tmp_path / "alone.pt")
    (tmp_path / "metrics.json").write_text("{")  # of nobody knows what
    assert predict(tmp_path / "alone.pt", tmp_path / "said.csv", *words) == 0
    assert "the classifier's data" not in capsys.readouterr().out
    assert "The net's data" not in (tmp_path / "said.html").read_text()


def test_labels_that_are_no_class_of_the_net_are_named(run, frame, capsys):
    rows = "depth,mask,object,label\n"
    for label in ("ball", "stool", "stool", "door"):
        rows += f"depth.png,mask.png,1,{label}\n"
    (frame / "objects.csv").write_text(rows)
    words = (f"depth={frame}/objects.csv", f"intrinsics={CAMERA}", "up=-y", "page=false")
    assert predict(run, frame / "said.csv", *words) == 0
    said = capsys.readouterr().out
    assert re.search(r"right [01] of 1 \(", said)
    assert "3 labels left out, no class of the classifier: stool 2, door 1\n" in said
    (frame / "objects.csv").write_text(rows.replace("stool", "rod").replace("door", "rod"))
    assert predict(run, frame / "said.csv", *words) == 0
    assert "left out, no class" not in capsys.readouterr().out


def test_intrinsics_of_another_resolution_are_cautioned(run, frame):
    fx, fy, cx, cy = SHOT.camera
    words = (f"depth={frame}/depth.png", f"mask={frame}/mask.png", "up=-y", "page=false")
    half = (fx / 2, fy / 2, cx / 2, cy / 2)
    numbers = ",".join(map(str, half))
    assert predict(run, frame / "said.csv", *words, f"intrinsics={numbers}") == 0
    depth, mask = seen()
    height, width = depth.shape
    told = f"lies 25% of a side from the middle of the picture of {width} x {height} px"
    assert all(told in row["caution"] for row in table(frame / "said.csv"))
    found = qs3.load(run).predict_depth(depth / 1000, half, mask=mask, up=(0, -1, 0))
    assert all("are those of another resolution" in one.cautions[-1] for one in found)
    assert predict(run, frame / "said.csv", *words, f"intrinsics={CAMERA}") == 0
    assert not any("principal point" in row["caution"] for row in table(frame / "said.csv"))


def test_labels_of_clouds_are_their_files_or_folders(run, tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "in" / "Rod" / "new").mkdir(parents=True)
    np.save(tmp_path / "in" / "Rod" / "new" / "a.npy", rng.normal(size=(64, 3)))
    np.savez(tmp_path / "in" / "b.npz", points=rng.normal(size=(2, 64, 3)), label=[2, 0])
    np.save(tmp_path / "in" / "c.npy", rng.normal(size=(64, 3)))
    assert predict(run, tmp_path / "said.csv", f"input={tmp_path}/in") == 0
    assert "m wide" not in (tmp_path / "said.html").read_text()  # files may be of any unit
    found = {row["file"]: row["label"] for row in table(tmp_path / "said.csv")}
    assert found == {"Rod/new/a.npy": "rod", "b.npz[0]": "slab", "b.npz[1]": "ball", "c.npy": ""}
