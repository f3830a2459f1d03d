"""`python -m qs3.tools.doctor`: its help. What it finds depends on the machine."""

from __future__ import annotations

import sys

import pytest

from qs3.tools import doctor


def test_help_is_plain(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["doctor", "--help"])
    with pytest.raises(SystemExit) as ended:
        doctor.main()
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith("usage: python -m qs3.tools.doctor")
    assert "Says what works on this machine" in said
    assert "`" not in said


def test_a_check_says_whether_it_works():
    good = doctor.Check("good", "print('first'); print('1.2')", (), "")
    bad = doctor.Check("bad", "raise SystemExit('no library')", (), "")
    ends = doctor.Check("ends", "import os; os._exit(3)", (), "")
    assert doctor.run(good) == (True, "1.2")
    assert doctor.run(bad) == (False, "no library")
    assert doctor.run(ends) == (False, "ended with status 3")
