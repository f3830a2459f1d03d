"""`qs3 doctor`. What it finds depends on the machine."""

from __future__ import annotations

from qs3.commands import doctor


def test_whether_a_check_works():
    good = doctor.Check("good", "print('first'); print('1.2')", "")
    lacks = doctor.Check("lacks", "raise SystemExit('no library')", "")
    ends = doctor.Check("ends", "import os; os._exit(3)", "")
    assert doctor.run(good) == (True, "1.2")
    assert doctor.run(lacks) == (False, "no library")
    assert doctor.run(ends) == (False, "ended with status 3")
