"""Sheets of datasets: the right clouds, named, complete and repeatable."""

import numpy as np

from qs3.report import sheets
from qs3.store.meta import ManifestRow
from qs3.store.store import write_pointset
from qs3.utils.pictures import save_png
from tests.report.made_runs import not_blank


def store(folder, ids, **more):
    rows = [ManifestRow(name, name.split("/")[0], "train", more=more) for name in ids]
    points = [np.random.default_rng(i).normal(size=(20, 3)) for i in range(len(ids))]
    return write_pointset(
        folder, name="x", classes=("bed", "chair", "sofa"), arrays={"points": points}, rows=rows,
        meta={},
    ), rows  # fmt: skip


def words(figure):
    return [text.get_text() for text in figure.texts]


def test_same_object_in_all_domains_where_possible(tmp_path):
    a, _ = store(tmp_path / "a", ["bed/1", "bed/2", "chair/1"])
    b, _ = store(tmp_path / "b", ["bed/2", "bed/3"])
    c, _ = store(tmp_path / "c", ["bed/9", "sofa/1"])
    beds = sheets._same_object([a, b, c], "bed")
    for found, (data, index) in zip(beds, [(a, 1), (b, 0), (c, 0)], strict=True):
        np.testing.assert_array_equal(found, data.points[index])
    titles = words(sheets.scan_picture({"A": a, "B": b, "C": c}))
    assert {"A", "B", "C", "bed", "chair", "no chair", "sofa", "no sofa"} <= {*titles}


def test_a_class_sheet_has_a_row_a_class(tmp_path):
    data, _ = store(tmp_path / "d", [f"bed/{i}" for i in range(9)] + ["sofa/椅子"])
    figure = sheets.class_sheet(data, "train", "all of them")
    assert {"bed", "sofa", "all of them", "椅子"} <= {*words(figure)}
    assert len([title for title in words(figure) if title.isdigit()]) == 6
    save_png(figure, tmp_path / "a.png", colours=256)
    assert not_blank(tmp_path / "a.png")


def test_what_is_drawn_is_not_at_even_steps():
    """Families of a catalogue take turns: at even steps all shown would be of one."""
    found = sheets.drawn(np.arange(100), 10)
    assert found == sorted({*found})
    assert len({i % 10 for i in found}) > 4
    assert sheets.drawn(np.array([5, 7]), 2) == [5, 7]
