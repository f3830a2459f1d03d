"""The class balance of domains: every count of every split is written at its bar."""

import numpy as np
import pytest

from qs3.errors import DataError
from qs3.report.figures.class_balance import _summary, class_picture
from qs3.store.store import ManifestRow, write_pointset


def store(folder, counts, classes=("bed", "chair", "sofa")):
    rows = [
        ManifestRow(f"{cls}/{split}/{i}", cls, split)
        for split, of_class in counts.items()
        for cls, count in zip(classes, of_class, strict=True)
        for i in range(count)
    ]
    points = np.zeros((len(rows), 4, 3), dtype=np.float32)
    return write_pointset(
        folder, name="x", classes=classes, arrays={"points": points}, rows=rows, meta={}
    )


def test_what_a_domain_is_summed_up_as(tmp_path):
    data = store(tmp_path / "a", {"train": (2, 10, 4), "test": (3, 0, 3)})
    assert _summary(data) == (
        "16 train (largest class / smallest 5.0), "
        "6 test (largest class / smallest 1.0, none of 1 class)"
    )


def test_picture(tmp_path):
    a = store(tmp_path / "a", {"train": (2, 10, 4), "test": (3, 1, 3)})
    b = store(tmp_path / "b", {"train": (1, 1, 1)})
    path = class_picture({"A": a, "B": b}, tmp_path / "p.png")
    again = class_picture({"A": a, "B": b}, tmp_path / "q.png")
    assert path.stat().st_size > 10_000
    assert path.read_bytes() == again.read_bytes()
    with pytest.raises(DataError):
        class_picture({}, tmp_path / "none.png")
