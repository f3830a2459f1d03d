"""Locks between processes: one that refuses."""

import pytest

from qs3.errors import Qs3Error
from qs3.utils.locks import alone, owned


def test_a_lock_that_is_held_is_refused_in_the_words_given_and_free_afterwards(tmp_path):
    path = tmp_path / "folder" / ".lock"
    with alone(path, "unused"):
        with pytest.raises(Qs3Error, match=r"^busy$"), alone(path, "busy"):
            pass
        with (
            pytest.raises(Qs3Error, match=r"another process is searching in .*; wait"),
            owned(path.parent, "searching in", "wait"),
        ):
            pass
    with alone(path, "busy"):
        assert path.is_file()
