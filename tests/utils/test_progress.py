"""The bar of downloads, on a terminal and elsewhere."""

from __future__ import annotations

import pytest

from qs3.utils.progress import byte_bar


@pytest.mark.parametrize(("total", "of"), [(30, "30"), (None, "?")])
def test_a_terminal_shows_what_is_there(total, of, capsys, monkeypatch):
    for name, value in {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "120"}.items():
        monkeypatch.setenv(name, value)  # a terminal, to rich
    with byte_bar("[a]", total, done=10) as advance:
        for _ in range(2):
            advance(10)
    shown = capsys.readouterr().err
    assert "[a]" in shown
    assert shown.index(f"10/{of} bytes") < shown.index(f"30/{of} bytes")


def test_a_file_gets_no_bar(capsys):
    with byte_bar("a", 3) as advance:
        advance(3)
    assert capsys.readouterr() == ("", "")
