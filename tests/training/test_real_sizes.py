"""Own clouds that are not in metres, or not above the floor, though their config says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError
from qs3.store.meta import ManifestRow
from qs3.store.store import open_pointset, write_pointset
from qs3.training.command import train
from qs3.training.load import check_real_sizes


def boxes(*sizes: float, scale: str = "metres", lowest: float = 0.0) -> Clouds:
    """A cube of each edge length, in metres, that stands at `lowest` above the floor."""
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), -1).reshape(-1, 3)
    stored = np.array([corners * size + (0, 0, lowest) for size in sizes], dtype=np.float32)
    names = tuple(f"scan{i}" for i in range(len(sizes)))
    return Clouds.of(stored, scale=scale, names=names)


FURNITURE = (0.3, 0.5, 0.5, 2.0)


def test_a_target_in_millimetres_is_refused():
    scans = boxes(300, 500, 0.5)
    with pytest.raises(DataError, match="own"):
        check_real_sizes("own", boxes(*FURNITURE), scans)
    check_real_sizes("own", boxes(*FURNITURE, scale="unit_ball"), scans)  # sizes do not matter
    with pytest.raises(DataError, match="own"):  # in any of its parts
        check_real_sizes("own", boxes(*FURNITURE), boxes(0.5), scans)
    with pytest.raises(DataError, match="own"):
        check_real_sizes("own", boxes(300, 500, 500, 2000), boxes(0.4, 0.6))


@pytest.mark.parametrize(("lowest", "warns"), [(-1.2, True), (-0.2, False)])
def test_a_floor_that_clouds_reach_through(lowest, warns, caplog: pytest.LogCaptureFixture):
    source = boxes(*FURNITURE, scale="above_floor")
    scans = boxes(0.4, 0.6, scale="above_floor", lowest=lowest)
    check_real_sizes("own", source, scans)
    assert bool(caplog.messages) == warns


def test_a_training_finds_it_before_it_trains(toy, toy_data: Path, tmp_path: Path):
    old = open_pointset(toy_data / "kinectsim10")
    rows = [
        ManifestRow(id=id_, cls=old.classes[label], split=split)
        for id_, label, split in zip(old.ids, old.labels, old.splits, strict=True)
    ]
    write_pointset(
        tmp_path / "kinectsim10",
        name="kinectsim10",
        classes=old.classes,
        arrays={"points": np.array(old.points) * 1000},
        rows=rows,
        meta={},
    )
    metres = ("data.source.unit=metres", "data.target.unit=metres", "data.scale=metres")
    with pytest.raises(DataError, match="kinectsim10"):
        train(toy(*metres, f"data.target.path={tmp_path / 'kinectsim10'}"))
