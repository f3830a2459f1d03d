"""Pictures: the projection has known answers; files are written, complete and repeatable."""

import matplotlib.image
import numpy as np
import pytest

from qs3.errors import DataError
from qs3.geometry.orthographic import project
from qs3.report.contact_sheets import contact_sheet, scan_picture
from qs3.store.store import ManifestRow, write_pointset
from tests.fixtures.published import CLASSES, cloud, write_domain
from tests.running import main


def test_projection_keeps_up_up_and_right_right():
    rng = np.random.default_rng(0)
    pole = np.stack([np.zeros(50), np.zeros(50), rng.uniform(0, 2, 50)], axis=1)
    seen, depth, height = project(pole)
    assert np.abs(seen[:, 0]).max() < 1e-12  # upright stays upright
    assert np.corrcoef(seen[:, 1], height)[0, 1] == pytest.approx(1)
    assert (np.diff(depth) >= 0).all()  # drawn from far to near


def test_projection_does_not_mirror():
    """The viewer stands at +x, -y and looks back: what is towards +x, +y is on the right."""
    marked = np.array([[1, 1, 0.1], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]])
    seen, depth, height = project(marked)
    assert np.linalg.norm(seen, axis=1).max() <= 1 + 1e-9
    assert seen[height == 1, 0] > 0.9
    assert seen[depth == 1, 1] < seen[depth == 0, 1]  # seen from above: near things are lower


def test_projection_of_a_single_point():
    seen, depth, height = project(np.ones((1, 3)))
    assert np.isfinite([*seen.ravel(), *depth, *height]).all()


def test_contact_sheet_of_names_in_any_script(tmp_path):
    path = contact_sheet([cloud("chair", "x", 300)], ["椅子"], tmp_path / "a.png", heading="十")
    assert matplotlib.image.imread(path).ndim == 3


def test_contact_sheet(tmp_path):
    clouds = [cloud(cls, "x", 300) for cls in CLASSES]
    path = contact_sheet(clouds, CLASSES, tmp_path / "a.png", columns=5, heading="ten")
    image = matplotlib.image.imread(path)
    assert image.shape[1] > image.shape[0] * 1.5
    assert 0.02 < (image[..., :3].min(axis=2) < 0.8).mean() < 0.6  # neither blank nor black
    again = contact_sheet(clouds, CLASSES, tmp_path / "b.png", columns=5, heading="ten")
    assert path.read_bytes() == again.read_bytes()


def test_nothing_to_draw(tmp_path):
    with pytest.raises(DataError):
        contact_sheet([], [], tmp_path / "a.png")
    with pytest.raises(DataError):
        contact_sheet([np.zeros((3, 3))], [], tmp_path / "a.png")
    with pytest.raises(DataError):
        scan_picture({}, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def store(folder, ids):
    rows = [ManifestRow(name, name.split("/")[0], "train") for name in ids]
    points = [np.random.default_rng(i).normal(size=(20, 3)) for i in range(len(ids))]
    return write_pointset(
        folder, name="x", classes=("bed", "chair", "sofa"), arrays={"points": points}, rows=rows,
        meta={},
    )  # fmt: skip


def test_same_object_in_all_domains_where_possible(tmp_path):
    from qs3.report.contact_sheets import _same_object

    a = store(tmp_path / "a", ["bed/1", "bed/2", "chair/1"])
    b = store(tmp_path / "b", ["bed/2", "bed/3"])
    c = store(tmp_path / "c", ["bed/9", "sofa/1"])
    beds = _same_object([a, b, c], "bed")
    for found, (data, index) in zip(beds, [(a, 1), (b, 0), (c, 0)], strict=True):
        np.testing.assert_array_equal(found, data.points[index])
    assert [x is None for x in _same_object([a, b, c], "sofa")] == [True, True, False]
    path = scan_picture({"A": a, "B: words": b, "C": c}, tmp_path / "p.png", note="n")
    assert path.stat().st_size > 5000


def test_command_line(tmp_path, capsys):
    for name in ("specklenet10", "kinectsim10"):
        write_domain(name, tmp_path, {"train": 1, "test": 1}, published=False)
    domains = "domains=[specklenet10,kinectsim10]"
    places = [f"data_dir={tmp_path}", f"out={tmp_path / 'out'}"]
    assert main(["report", "pictures", domains, *places]) == 0
    assert capsys.readouterr().out.splitlines() == [
        str(tmp_path / "out" / f"{name}.png")
        for name in ("specklenet10", "kinectsim10", "classes", "domains")
    ]
    alone = tmp_path / "alone" / "scans.png"
    assert main(["report", "pictures", domains, f"paths.data_dir={tmp_path}", f"out={alone}"]) == 0
    assert capsys.readouterr().out == f"{alone}\n"
    assert list(alone.parent.iterdir()) == [alone]
    assert main(["report", "pictures", "domains=[scannet10]", f"data_dir={tmp_path}"]) == 1
    assert "MissingDataError: domain scannet10" in capsys.readouterr().err
    assert main(["report", "pictures", "domains=[specklenet1]", f"data_dir={tmp_path}"]) == 1
    assert "domains: specklenet1 is not a domain (did you mean specklenet10?)" in (
        capsys.readouterr().err
    )
    assert main(["report", "pictures"]) == 1
