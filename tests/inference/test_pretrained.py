"""Classifiers that come with qs3: found by name, chosen by what is known of the clouds."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest

import qs3
from qs3.classes import CLASSES
from qs3.datasets.arrays import named_arrays
from qs3.errors import MissingDataError
from qs3.inference import pretrained
from qs3.inference.export import export_folder
from qs3.inference.model_file import find_result, write_result
from qs3.inference.scores import DISPUTED
from tests.running import main


@pytest.fixture
def own(run, high_net, tmp_path, monkeypatch):
    """Toy nets under the names of the two that are chosen; a cloud to ask them about."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    export_folder(run, tmp_path / "pretrained" / pretrained.ANY_SIZE)
    export_folder(high_net, tmp_path / "pretrained" / pretrained.HEIGHTS)
    (tmp_path / "pretrained" / "empty").mkdir()
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "a.npy", np.random.default_rng(0).normal(size=(90, 3)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_second_classifier_is_asked_and_counted(own, run, capsys):
    first = qs3.load(run)
    other = replace(first.result, classes=("slab", "ball", "rod"))  # never says the same
    write_result(own / "other.pt", other)
    clouds = np.random.default_rng(1).normal(size=(6, 90, 3))
    best = first(clouds).argmax(axis=1)
    labels = [first.classes[k] for k in best[:3]] + [other.classes[k] for k in best[3:]]
    for i, (cloud, label) in enumerate(zip(clouds, labels, strict=True)):
        (own / "labelled" / label).mkdir(parents=True, exist_ok=True)
        np.save(own / "labelled" / label / f"{i}.npy", cloud)
    words = (f"ckpt={run}", "input=labelled", "out=said.csv")
    text = said(capsys, *words, "second=other.pt")
    assert "says the same of 0 of 6 (column second)" in text
    assert "look yourself; not: 3 of 6 right (50.0%)" in text
    rows = list(csv.DictReader((own / "said.csv").read_text().splitlines()))
    names = dict(zip(first.classes, other.classes, strict=True))
    assert [row["second"] for row in rows] == [names[row["class"]] for row in rows]
    text = said(capsys, *words, f"second={run}", "page=true")
    assert "says the same of 6 of 6" in text
    assert "same: 3 of 6 right (50.0%)" in text
    assert "not:" not in text
    assert DISPUTED not in (own / "said.html").read_text()
    said(capsys, *words, "second=other.pt", "page=true")
    page = (own / "said.html").read_text()
    assert f"{DISPUTED}: " in page
    cells = re.sub(r"<[^>]*>", "|", page)
    assert re.search(rf"{DISPUTED}\|+3 of 6 \(50%\)\|+0 of 0", cells)
    assert "second classifier" not in said(capsys, *words)
    write_result(own / "more.pt", replace(other, classes=("slab", "ball", "cup")))
    for prior in ([], ["prior=rod:3"]):
        assert main(["predict", *words, "second=more.pt", *prior]) == 1
        assert "second=more.pt tells slab, ball, cup apart" in capsys.readouterr().err
    text = said(capsys, *words, f"second={run}", "prior=ball:0")
    assert "says the same of 6 of 6" in text  # the second classifier never says it either
    assert main(["predict", *words, "second=dgcnn-rooms"]) == 1
    assert "second=dgcnn-rooms knows heights: give floor=" in capsys.readouterr().err


def test_of_those_that_come_with_qs3_another_net_is_the_second(own, run, capsys):
    assert "second classifier" not in said(capsys, "input=scans")  # there is no such net here
    export_folder(run, own / "pretrained" / pretrained.SECOND)
    assert "a second classifier says the same of 1 of 1" in said(capsys, "input=scans")
    assert "second classifier" not in said(capsys, "input=scans", "second=none")
    assert "second classifier" not in said(capsys, "input=scans", f"ckpt={run}")


def said(capsys, *words):
    assert main(["predict", *["page=false"] * ("page=true" not in words), *words]) == 0
    return capsys.readouterr().out


def test_what_comes_with_qs3_is_whole_and_knows_scans_of_meshes_it_never_saw():
    assert {pretrained.ANY_SIZE, pretrained.HEIGHTS} <= {*pretrained.names()}
    size = sum(file.stat().st_size for file in pretrained.FOLDER.rglob("*") if file.is_file())
    assert size < 25e6  # a package is not the place for more
    sample = named_arrays(pretrained.FOLDER / "source_sample.npz")
    truth = sample["cls"]
    for name in pretrained.names():
        predictor = qs3.load(name)
        assert predictor.classes == CLASSES
        floor = 0.0 if predictor.needs_floor else None
        said = predictor(sample["points"][::4].astype(np.float32), floor=floor)
        right = np.mean(np.array(CLASSES)[said.argmax(axis=1)] == truth[::4])
        assert right > 0.6, name
        card = (pretrained.FOLDER / name / "README.md").read_text()
        assert "On real objects of `nyuv2_train_objects.npz`" in card
        assert predictor.result.worth.startswith("right about ")


def test_by_name_unless_something_here_has_it(own):
    assert pretrained.names() == sorted([pretrained.ANY_SIZE, pretrained.HEIGHTS])
    name = pretrained.ANY_SIZE
    assert find_result(name) == own / "pretrained" / name / "model.safetensors"
    assert qs3.load(name).classes == ("ball", "rod", "slab")
    export_folder(own / "pretrained" / pretrained.HEIGHTS, own / name)  # somebody's own
    assert qs3.load(name).needs_floor
    for wrong in ("empty", "dgcnn-speckel", "../pretrained/x"):
        with pytest.raises(MissingDataError, match=r"(empty|speckel|x) is not there; .* dgcnn-"):
            qs3.load(wrong)


def test_without_a_name_what_is_known_of_the_clouds_decides(own, capsys):
    text = said(capsys, "input=scans")
    assert "classifier: dgcnn-speckle, which comes with qs3 (ckpt=); floor=Z, if they are" in text
    text = said(capsys, "input=scans", "floor=0")
    assert "classifier: dgcnn-rooms, which comes with qs3 and knows sizes and heights" in text
    assert "classifier:" not in said(capsys, "input=scans", "ckpt=dgcnn-speckle")
    depth = np.full((120, 160), 2.0)
    np.save(own / "depth.npy", depth)
    words = ("depth=depth.npy", "box=40,30,120,90", "intrinsics=150,150,79.5,59.5", "up=0,-1,0")
    text = said(capsys, *words)
    assert text.startswith(
        "classifier: dgcnn-speckle, which comes with qs3 (ckpt=); camera_height="
    )
    assert "classifier: dgcnn-rooms" in said(capsys, *words, "camera_height=1.2")


def archive(path, end, count=40):
    """Boxes whose lowest points lie at `end`, for an archive of objects."""
    rng = np.random.default_rng(0)
    tenths = rng.integers(-2500, 2500, (count * 200, 3)).astype(np.int16)
    names = np.array(["chair"] * count)
    np.savez(
        path,
        xyz_tenth_mm=tenths,
        centre_m=np.tile([0.0, 2.0, end + 0.25], (count, 1)),
        start=np.arange(count + 1) * 200,
        cls=names,
        tier=np.array(["clean"] * count),
        img=np.arange(count),
    )


def test_an_archive_says_itself_where_its_floor_is(own, high_net, capsys):
    archive("objects.npz", end=-1.4)
    text = said(capsys, "input=objects.npz", "page=true", "out=said.csv").splitlines()
    assert text[0].startswith("classifier: dgcnn-rooms, which comes with qs3 and knows sizes")
    assert text[1].startswith("the floor is taken to lie at z = -1.4, by the lowest points of 40 ")
    assert "The floor is taken to lie at z = -1.4" in (own / "said.html").read_text()
    found = (own / "said.csv").read_text()
    few = said(capsys, "input=objects.npz", "sample=5")  # all of them are asked
    assert "z = -1.4, by the lowest points of 40 " in few
    given = said(capsys, "input=objects.npz", "floor=-1.4", "out=given.csv")
    assert "is taken to lie" not in given
    assert (own / "given.csv").read_text() == found

    # a net of one's own knows its camera's height, and one that came from scans of z = 0 does not
    knows = said(capsys, "input=objects.npz", f"ckpt={high_net}")
    assert "the camera counts as 1.25 m above the floor" in knows
    write_result(own / "zero.pt", replace(qs3.load(high_net).result, floor_m=0.0))
    assert "is taken to lie at z = -1.4" in said(capsys, "input=objects.npz", "ckpt=zero.pt")
    both = said(capsys, "input=objects.npz", "ckpt=dgcnn-speckle", "second=zero.pt")
    assert "is taken to lie at z = -1.4" in both
    assert "is taken to lie" not in said(capsys, "input=objects.npz", "ckpt=dgcnn-speckle")

    archive("objects.npz", end=-0.5)  # on tables
    text = said(capsys, "input=objects.npz")
    assert text.startswith("classifier: dgcnn-speckle, which comes with qs3 (ckpt=); floor=-METRES")
    assert "a camera 0.5 m above the floor is not what" in text.splitlines()[0]
    assert main(["predict", "input=objects.npz", "ckpt=zero.pt"]) == 1
    assert "give its height, floor=-METRES (the lowest of 40 objects" in capsys.readouterr().err
