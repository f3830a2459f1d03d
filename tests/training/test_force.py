"""`force=true` begins a run anew, and loses no result where it cannot."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from qs3.config import hashing
from qs3.errors import DataError, MissingDataError
from qs3.training.command import train


def without(data: Path) -> None:
    shutil.rmtree(data)


def damaged(data: Path) -> None:
    (data / "kinectsim10" / "points.npy").write_bytes(b"")


@pytest.mark.parametrize("ruin", [without, damaged])
def test_an_old_result_stays_where_its_data_cannot_be_opened(toy, toy_data, tmp_path, ruin):
    """Such as of a mistyped folder: where data lie is no part of a run's name."""
    folder = hashing.run_folder(toy())
    for name in ("metrics.json", "result.pt", "round_00/pseudo_labels.csv"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    shutil.copytree(toy_data, tmp_path / "data")
    ruin(tmp_path / "data")
    with pytest.raises(MissingDataError if ruin is without else DataError):
        train(toy(f"paths.data_dir={tmp_path / 'data'}", "force=true"))
    for name in ("metrics.json", "result.pt", "round_00/pseudo_labels.csv"):
        assert (folder / name).read_text() == name
