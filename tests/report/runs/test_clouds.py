"""A run's clouds: the sheets hold the right ones, and what cannot be drawn is said."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from omegaconf import OmegaConf

from qs3.errors import Qs3Error
from qs3.report import contact_sheets as pictures
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.runs import clouds as run_clouds
from qs3.report.runs.clouds import cloud_pictures
from qs3.report.runs.data import read_run
from qs3.report.runs.pictures import draw as draw_run
from qs3.runs.metrics import DataHashes
from qs3.runs.predictions import Predictions, read_predictions
from qs3.store.store import ManifestRow, open_pointset, write_pointset
from tests.report.made_runs import change, not_blank, table
from tests.training.toy import CLASSES, write_domain


@pytest.fixture
def sheets(monkeypatch):
    """What is handed to each contact sheet; the sheet is drawn all the same."""
    seen = []

    def watched(points, titles, path, **words):
        seen.append({"points": points, "titles": titles, **words})
        return pictures_contact_sheet(points, titles, path, **words)

    pictures_contact_sheet = pictures.contact_sheet
    monkeypatch.setattr(pictures, "contact_sheet", watched)
    monkeypatch.setattr(run_clouds, "contact_sheet", watched)
    return seen


def draw(run, name, path, data_dir=None):
    cloud_pictures(read_run(run), data_dir)[name](path)
    return path


def why_not(run, name, path, data_dir=None):
    with pytest.raises((NothingToDrawError, Qs3Error)) as error:
        draw(run, name, path, data_dir)
    assert not path.exists()
    return str(error.value)


def test_mistakes_are_those_of_the_table_surest_first(run, toy_data, tmp_path, sheets):
    assert not_blank(draw(run, "mistakes", tmp_path / "m.png"))
    rows = [r for r in table(run / "predictions.csv") if r["label"] != r["predicted"]]
    rows.sort(key=lambda row: -float(row[f"p_{row['predicted']}"]))
    (sheet,) = sheets
    assert sheet["titles"] == [
        f"{r['predicted']} {float(r['p_' + r['predicted']]):.2f}, is {r['label']}" for r in rows
    ]
    data = open_pointset(toy_data / "kinectsim10")
    for points, row in zip(sheet["points"], rows, strict=True):
        np.testing.assert_array_equal(points, data.points[data.ids.index(row["id"])])
    assert f"most confident of {len(rows)} mistakes in 24 clouds" in sheet["heading"]
    assert "(K, simulated)" in sheet["heading"]


def test_one_mistake_of_each_mesh():
    """Scans of one mesh are one mistake: the most confident of them is shown."""
    sure = np.array([0.6, 0.9, 0.8, 0.7])
    said = Predictions(("a", "b"), tuple("wxyz"), ("m", "m", "n", "o"), np.full(4, 1),
                       np.stack([sure, 1 - sure], axis=1))  # fmt: skip
    assert run_clouds._surest(said, np.array([True, True, True, False])) == [1, 2]
    rooms = replace(said, labels=np.array([1, 0, 1, 1]))  # "m" holds both classes: no mesh
    assert run_clouds._surest(rooms, np.array([True, True, True, False])) == [1, 2, 0]


def test_without_labels_there_are_rows_of_what_the_net_named(run, tmp_path, sheets):
    said = read_predictions(run / "predictions.csv")
    lines = (run / "predictions.csv").read_text().splitlines()
    cells = [line.split(",") for line in lines]
    (run / "predictions.csv").write_text(
        "\n".join(",".join([*c[:2], "" if i else c[2], *c[3:]]) for i, c in enumerate(cells)) + "\n"
    )
    makers = cloud_pictures(read_run(run))
    assert "mistakes" not in makers
    makers["named"](tmp_path / "n.png")
    (sheet,) = sheets
    named = [name for k, name in enumerate(CLASSES) if (said.predicted == k).any()]
    assert list(sheet["rows"]) == named
    rows = [sheet["titles"][i : i + 6] for i in range(0, len(sheet["titles"]), 6)]
    for name, row in zip(named, rows, strict=True):
        sure = [float(title.split()[1]) for title in row if title]
        assert {title.split()[0] for title in row if title} == {name}
        assert sure == sorted(sure, reverse=True)


def test_a_sheet_has_a_row_a_class_and_spreads_over_it(tmp_path, sheets):
    names = [f"bed/{i}" for i in range(13)] + ["sofa/0", "sofa/1"]
    rows = [ManifestRow(name, name.split("/")[0], "train") for name in names]
    clouds = [np.full((4, 3), i, dtype=np.float32) + np.eye(4, 3) for i in range(len(names))]
    data = write_pointset(
        tmp_path / "x", name="x", classes=("bed", "chair", "sofa"), arrays={"points": clouds},
        rows=rows, meta={},
    )  # fmt: skip
    pictures.class_sheet(data, tmp_path / "s.png", heading="h")
    (sheet,) = sheets
    assert sheet["rows"] == ("bed", "sofa")  # no row for a class without clouds
    beds = [int(title) for title in sheet["titles"][:6]]
    assert sorted({*beds}) == beds  # six different ones, in order
    assert len({*np.diff(beds)}) > 1  # families of a catalogue take turns: not at even steps
    assert sheet["titles"][6:] == ["0", "1", "", "", "", ""]
    assert [p is None for p in sheet["points"]] == [False] * 8 + [True] * 4


def saw(run, data_dir, source="specklenet10", target="kinectsim10"):
    """Note in the run that it was trained on these datasets."""
    hashes = {
        role: open_pointset(data_dir / name).sha256
        for role, name in (("source", source), ("target", target))
    }
    change(run, data=DataHashes(**hashes))


def test_unlabelled_domain(run, tmp_path, sheets):
    data_dir = tmp_path / "data"
    write_domain(data_dir, "specklenet10", noise=0.05)
    rows = [ManifestRow(f"room/{i:03d}", "", "train") for i in range(100)]
    write_pointset(
        data_dir / "kinectsim10", name="kinectsim10", classes=CLASSES, rows=rows, meta={},
        arrays={"points": np.random.default_rng(0).normal(size=(100, 16, 3)).astype(np.float32)},
    )  # fmt: skip
    saw(run, data_dir)
    assert not_blank(draw(run, "target_clouds", tmp_path / "t.png", data_dir))
    titles = sheets[0]["titles"]
    assert len({*titles}) == 60
    assert titles == sorted(titles)
    assert not_blank(draw(run, "class_balance", tmp_path / "b.png", data_dir))
    assert "no labels" in why_not(run, "domains", tmp_path / "d.png", data_dir)


def test_other_data_damaged_data_no_data(run, toy_data, tmp_path):
    out = tmp_path / "x.png"
    for name in ("domains", "source_clouds", "class_balance"):
        assert "specklenet10, is not at" in why_not(run, name, out, tmp_path / "nowhere")
    data_dir = tmp_path / "copy"
    shutil.copytree(toy_data, data_dir)
    (data_dir / "kinectsim10" / "points.npy").write_bytes(b"no array")
    assert "points.npy" in why_not(run, "target_clouds", out, data_dir)
    assert not_blank(draw(run, "source_clouds", tmp_path / "s.png", data_dir))
    change(run, data=DataHashes(source="0" * 64, target="0" * 64))
    assert "another version" in why_not(run, "mistakes", out)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("data.source._target_", "shutil.rmtree"),
        ("data.source._recursive_", True),
        ("data.source.published._target_", "os.remove"),
    ],
)
def test_a_config_runs_nothing(run, tmp_path, place, value):
    """A run's folder may be somebody else's: whatever it names, a domain's data are opened."""
    path = run / ".hydra" / "config.yaml"
    config = OmegaConf.load(path)
    OmegaConf.update(config, place, value, force_add=True)
    OmegaConf.save(config, path)
    assert not_blank(draw(run, "source_clouds", tmp_path / "s.png"))


@pytest.mark.parametrize("text", ["a: 1", "data: {source: 3}", "data: {source: {name: x}}"])
def test_a_config_without_domains_costs_no_other_picture(run, text, tmp_path):
    (run / ".hydra" / "config.yaml").write_text(text)
    drawn = draw_run(run, tmp_path, embed=False)
    assert {"curves", "confusion", "calibration"} <= set(drawn.pictures)
    assert "describes no domain" in drawn.skipped["source_clouds"]
    assert drawn.page.is_file()


def test_domains_stand_side_by_side_under_their_names(run, toy_data, tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(run_clouds, "scan_picture", lambda sets, path: seen.update(sets))
    draw(run, "domains", tmp_path / "d.png")
    assert [(title, data.name) for title, data in seen.items()] == [
        ("S: SpeckleNet10", "specklenet10"),
        ("K: kinectsim10 (simulated)", "kinectsim10"),
    ]
    config = OmegaConf.load(run / ".hydra" / "config.yaml")
    config.data.target = config.data.source
    OmegaConf.save(config, run / ".hydra" / "config.yaml")
    saw(run, toy_data, target="specklenet10")
    seen.clear()
    draw(run, "domains", tmp_path / "d.png")
    assert list(seen) == ["S: SpeckleNet10, source", "S: SpeckleNet10, target"]
