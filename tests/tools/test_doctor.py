"""`qs3 doctor`. What it finds depends on the machine."""

from __future__ import annotations

from qs3.tools import doctor
from tests.running import main

ABSENT = doctor.Check("Thing", "raise SystemExit('no library')", ("libthing1",), "no things")


def test_a_check_says_whether_it_works():
    good = doctor.Check("good", "print('first'); print('1.2')", (), "")
    ends = doctor.Check("ends", "import os; os._exit(3)", (), "")
    assert doctor.run(good) == (True, "1.2")
    assert doctor.run(ABSENT) == (False, "no library")
    assert doctor.run(ends) == (False, "ended with status 3")


def test_packages_are_installed_only_on_request(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(doctor, "CHECKS", (ABSENT,))
    monkeypatch.setattr(doctor, "install_packages", lambda names: asked.append(names) or False)
    assert main(["doctor"]) == 0
    assert "to fix it: apt-get install libthing1" in capsys.readouterr().out
    assert not asked
    assert main(["doctor", "install=true"]) == 0
    assert asked == [("libthing1",)]
