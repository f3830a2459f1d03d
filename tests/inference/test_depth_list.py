"""Lists of depth images: how they are written, and rows whose values cannot be."""

from __future__ import annotations

import csv

import pytest

from qs3.errors import DataError
from qs3.inference.depth_list import Shown, find_shown
from tests.running import main

CAMERA = "525,525,319.5,239.5"


def test_rows_of_a_list_whose_values_cannot_be_are_told(tmp_path):
    for value in ("-0.001", "0", "nan", "1000"):
        (tmp_path / "a.csv").write_text(f"depth,mask,depth_scale\na.png,m.png,{value}\n")
        ((one,), _) = find_shown(str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA))
        assert "metres a unit, in (0, 1]" in one.wrong
    (tmp_path / "a.csv").write_text('depth,box,object\na.png,"60,20,100,100",7\n')
    ((one,), _) = find_shown(str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA))
    assert "object=7 is the number of one of a mask; here is a box" in one.wrong


@pytest.mark.parametrize("mark", [";", "\t"])
def test_a_list_as_spreadsheets_write_it(tmp_path, mark):
    rows = [
        ["depth", "box", "mask", "object", "up", "depth_scale", "label"],
        ["a.png", "60,20,100,100", "", "", "0,-1,0", "", "rod, long"],
        ["b.png", "", "m.png", "7", "", "0.002", "slab"],
    ]
    lines = ["\ufeff" + mark.join(rows[0]), *(mark.join(row) for row in rows[1:])]
    (tmp_path / "a.csv").write_text("\r\n".join(lines) + "\r\n", encoding="utf-8")
    common = Shown("", intrinsics=CAMERA)
    (first, second), _ = find_shown(str(tmp_path / "a.csv"), "", common)
    assert (first.wrong, second.wrong) == ("", "")
    assert (first.box, first.up, first.label) == ((60, 20, 100, 100), (0, -1, 0), "rod, long")
    assert (second.mask, second.only, second.scale_m) == (tmp_path / "m.png", 7, 0.002)
    with open(tmp_path / "b.csv", "w", newline="") as file:  # with commas it says the same
        csv.writer(file).writerows(rows)
    assert find_shown(str(tmp_path / "b.csv"), "", common)[0] == [first, second]


def test_columns_have_any_case_and_blanks(tmp_path):
    (tmp_path / "a.csv").write_text("Depth ,MASK,Label\na.png,m.png,chair\n")
    ((one,), _) = find_shown(str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA))
    assert (one.wrong, one.mask, one.label) == ("", tmp_path / "m.png", "chair")
    for first, second, other in (("Depth", "depth", "Depth"), ("Depth", "DEPTH", "DEPTH")):
        (tmp_path / "a.csv").write_text(f"{first},{second},mask\na.png,b.png,m.png\n")
        with pytest.raises(DataError, match=f"unknown columns {other}; known"):  # which of both?
            find_shown(str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA))


def test_masks_without_a_depth_image_are_told(tmp_path, caplog):
    frames, masks = tmp_path / "frames", tmp_path / "masks"
    for folder, names in ((frames, "ab"), (masks, "bcd")):
        folder.mkdir()
        for name in names:
            (folder / f"{name}.png").touch()
    (first, second), _ = find_shown(str(frames), str(masks), Shown("", intrinsics=CAMERA))
    assert "no mask of its name" in first.wrong
    assert second.mask == masks / "b.png"
    assert f"mask={masks}: 2 masks have no depth image of the name, such as c.png" in caplog.text


def test_numbers_as_pandas_writes_them_and_homes_are_taken(tmp_path, monkeypatch):
    """A column of whole numbers with an empty cell is one of floats there: 3.0."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    text = "depth,mask,object\n~/a.png,~/m.png,3.0\nb.png,m.png,\n~$c.png,~m.png,\n"
    (tmp_path / "a.csv").write_text(text)
    (first, second, third), _ = find_shown(
        str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA)
    )
    assert (first.wrong, second.wrong, first.only, second.only) == ("", "", 3, None)
    home = tmp_path / "home"
    assert (first.depth, first.mask) == (home / "a.png", home / "m.png")
    assert (second.depth, second.mask) == (tmp_path / "b.png", tmp_path / "m.png")
    assert (third.depth, third.mask) == (tmp_path / "~$c.png", tmp_path / "~m.png")  # nobody's


def test_words_in_place_of_numbers_are_told_in_words(tmp_path):
    rows = "a.png,m.png,chair,\na.png,m.png,3,1mm\n"
    (tmp_path / "a.csv").write_text("depth,mask,object,depth_scale\n" + rows)
    (first, second), _ = find_shown(str(tmp_path / "a.csv"), "", Shown("", intrinsics=CAMERA))
    assert first.wrong.startswith("a.csv, row 1: object=chair: expected the whole number of an")
    assert second.wrong.startswith("a.csv, row 2: depth_scale=1mm: expected a number, the metres")


@pytest.mark.parametrize("number", ["3.7", "true", "1.0000001"])
def test_an_object_of_a_list_is_a_whole_number(tmp_path, number):
    (tmp_path / "a.yaml").write_text(f"- {{depth: a.png, mask: m.png, object: {number}}}\n")
    found, _ = find_shown(str(tmp_path / "a.yaml"), "", Shown("", intrinsics=CAMERA))
    assert "expected the whole number of an object" in found[0].wrong


def test_rows_of_a_list_with_numbers_without_end_are_told(tmp_path):
    rows = "- {depth: a.png, mask: m.png, object: .inf}\n"
    rows += f"- {{depth: a.png, box: [1, 2, 3, 1{'0' * 400}]}}\n"
    (tmp_path / "a.yaml").write_text(rows)
    found, _ = find_shown(str(tmp_path / "a.yaml"), "", Shown("", intrinsics=CAMERA))
    assert "object=inf: expected the whole number" in found[0].wrong
    assert "box=" in found[1].wrong
    (tmp_path / "a.yaml").write_text("- depth: 2020-99-99\n")
    with pytest.raises(DataError, match=r"a\.yaml is not readable: month must be"):
        find_shown(str(tmp_path / "a.yaml"), "", Shown(""))


def test_a_list_of_wrong_rows_alone_says_what_is_wrong_with_them(tmp_path, capsys):
    """And not that intrinsics are missing, which were given: in the list, or beside it."""
    rows = "- {depth: a.png, mask: m.png, object: [20, 30], label: chair}\n"
    (tmp_path / "a.yaml").write_text(rows)
    (tmp_path / "b.yaml").write_text(rows.replace("label", "intrinsics: k.yaml, label"))
    for name, beside in (("a", [f"intrinsics={CAMERA}"]), ("b", [])):
        words = [f"depth={tmp_path / name}.yaml", *beside, f"out={tmp_path / name}.csv"]
        assert main(["predict", "ckpt=pointnet-speckle", *words, "page=false"]) == 1
        assert f"{name}.yaml, row 1: object=[20, 30]: expected" in capsys.readouterr().out
        (row,) = csv.DictReader((tmp_path / f"{name}.csv").read_text().splitlines())
        assert (row["status"], row["label"]) == ("failed", "chair")
