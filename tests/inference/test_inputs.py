"""Which files of a folder `qs3 predict` and `qs3 view` read."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from qs3.errors import DataError
from qs3.inference.inputs import find_files


def test_a_folder_that_cannot_be_looked_into_is_not_passed_over(tmp_path: Path) -> None:
    """Here its path is too long for the system, which holds for root, too."""
    (tmp_path / "a.xyz").write_text("0 0 0\n1 1 1\n")
    assert find_files(tmp_path)[0] == [tmp_path / "a.xyz"]
    name = "b" * 250
    handle = os.open(tmp_path, os.O_RDONLY)
    for _ in range(17):
        os.mkdir(name, dir_fd=handle)
        inner = os.open(name, os.O_RDONLY, dir_fd=handle)
        os.close(handle)
        handle = inner
    os.close(handle)
    with pytest.raises(DataError, match=r"bbb cannot be read .File name too long"):
        find_files(tmp_path)
    shutil.rmtree(tmp_path / name)
