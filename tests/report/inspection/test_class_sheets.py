"""sheets/CLASS.png of `qs3 inspect`: whose clouds, how many, named by what, seen from where."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest

from qs3.report.inspection import class_sheets as sheets
from qs3.report.inspection.open_dataset import open_named
from qs3.store.store import ManifestRow, write_pointset
from tests.running import main


@pytest.fixture
def folder(tmp_path):
    """Fifty boxes and three plates for training, one of each for test."""
    rng = np.random.default_rng(0)
    rows, clouds = [], []
    for cls, split, count in (
        ("box", "train", 50), ("plate", "train", 3), ("box", "test", 1), ("plate", "test", 1)
    ):  # fmt: skip
        for i in range(count):
            tier = {"tier": ("clean", "hard")[i % 2]}
            rows.append(ManifestRow(f"{cls}/{split}/{i}", cls, split, more=tier))
            clouds.append(rng.random((64, 3)))
    write_pointset(
        tmp_path / "made", name="made", classes=("box", "lamp", "plate"),
        arrays={"points": clouds}, rows=rows, meta={},
    )  # fmt: skip
    return tmp_path / "made"


def test_a_sheet_of_each_class_that_is_there(folder, tmp_path, monkeypatch):
    said = {}

    def sheet(clouds, titles, path, heading):
        said[path.name] = [*titles], heading
        return draw(clouds, titles, path, heading)

    draw = sheets._sheet
    monkeypatch.setattr(sheets, "_sheet", sheet)
    opened = open_named(str(folder), {})
    saved = sheets.class_sheets(opened, tmp_path / "s", split="train", most=20)
    assert [path.name for path in saved] == ["box.png", "plate.png"]
    titles, heading = said["box.png"]
    assert heading == "box: 20 of 50 of made, train"
    names = [title.split("\n")[0] for title in titles]
    assert len({*names}) == 20
    tier_of = {str(i): ("clean", "hard")[i % 2] for i in range(50)}
    assert [title.split("\n")[1] for title in titles] == [tier_of[name] for name in names]
    assert said["plate.png"][1].startswith("plate: 3 of 3 of")
    few, many = (matplotlib.image.imread(saved[k])[..., :3] for k in (1, 0))
    assert few.shape[0] < many.shape[0]
    for image in (few, many):
        assert 0.005 < (image.min(axis=2) < 0.8).mean() < 0.6  # neither blank nor black
    before = [path.read_bytes() for path in saved]
    sheets.class_sheets(opened, tmp_path / "s", split="train", most=20)
    assert [path.read_bytes() for path in saved] == before
    sheets.class_sheets(opened, tmp_path / "s", split="train", most=20, seed=1)
    assert [title.split("\n")[0] for title in said["box.png"][0]] != names


def test_inspect_saves_them_unless_told_not_to(folder, tmp_path, capsys):
    words = ["inspect", str(folder), f"out={tmp_path / 'out'}"]
    assert main([*words, "sheets=0"]) == 0
    assert not (tmp_path / "out" / "sheets").exists()
    assert main(words) == 0
    assert "clouds.html, sheets/box.png and 1 more in " in capsys.readouterr().out
    assert (tmp_path / "out" / "sheets" / "plate.png").is_file()


@pytest.mark.parametrize("azimuth_deg", [0, 75, 160, -100])
def test_single_views_are_seen_from_their_camera(azimuth_deg):
    """A wall that faces the origin is wide there; around the origin all is seen as elsewhere."""
    rng = np.random.default_rng(0)
    side, up = rng.uniform(-1, 1, (2, 500))
    angle = np.deg2rad(azimuth_deg)
    across = np.array([-np.sin(angle), np.cos(angle)])
    wall = np.column_stack([np.outer(side, across), up])
    beside = wall + 3 * np.array([np.cos(angle), np.sin(angle), 0])
    seen, _ = sheets._seen(beside)
    radius = np.linalg.norm([side, up], axis=0).max()
    assert np.ptp(seen[:, 0]) == pytest.approx(2 * np.cos(np.deg2rad(20)) / radius, rel=0.03)
    around, _ = sheets._seen(wall)
    assert np.ptp(around[:, 0]) == pytest.approx(
        2 * abs(np.cos(angle - np.deg2rad(-55))) / radius, rel=0.03
    )


def test_names_of_files_are_harmless_and_differ():
    names = sheets.file_names(["a/b", "a?b", "A_B", "night stand", "..", "ü", "x" * 300])
    assert names == ["a_b", "a_b_2", "A_B_3", "night_stand", "_", "ü", "x" * 60]
    assert len({name.lower() for name in names}) == len(names)


def test_unlabelled_clouds_have_one_sheet(tmp_path):
    rows = [ManifestRow(f"{i}", "", "train") for i in range(3)]
    clouds = list(np.random.default_rng(0).random((3, 16, 3)))
    write_pointset(
        tmp_path / "u", name="u", classes=("a", "b"), arrays={"points": clouds}, rows=rows, meta={}
    )
    opened = open_named(str(tmp_path / "u"), {})
    (saved,) = sheets.class_sheets(opened, tmp_path / "s", split="train")
    assert saved.name == "all.png"
