"""Files that would take too much memory are refused by their size, before they are read."""

import pytest

from qs3.errors import DataError
from qs3.utils.memory import read_whole


def test_the_peak_is_what_counts(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    monkeypatch.setenv("QS3_MEMORY_GB", "0.00001")  # 10,000 bytes
    assert read_whole(path, 10) == b"x" * 1000
    with pytest.raises(DataError, match="a takes"):
        read_whole(path, 11)
