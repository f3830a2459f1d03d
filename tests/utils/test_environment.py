"""Scripts that are run by a Python without the packages."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from qs3.utils.environment import needs_packages
from tests.running import ROOT


@pytest.mark.parametrize("script", ["train.py", "generate.py"])
def test_a_python_without_packages_is_told_what_to_do(script, tmp_path):
    """`-S` leaves out site-packages, as a Python does that is not the environment's."""
    done = subprocess.run(
        [sys.executable, "-S", str(ROOT / script), "--help"],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"hydra is not installed for {sys.executable}")
    assert f"source {ROOT}/.venv/bin/activate" in line
    assert ("make install" in line) == (not (ROOT / ".venv" / "installed").is_file())


def test_make_install_is_said_where_it_was_not_done(tmp_path):
    """And not where it was: then the environment is only not the active one."""
    said = []
    for made in (False, True):
        if made:
            (tmp_path / ".venv").mkdir()
            (tmp_path / ".venv" / "installed").touch()
        with pytest.raises(SystemExit) as told, needs_packages(tmp_path):
            import no_such_package_of_anyone  # noqa: F401
        said.append(told.value.code)
    assert "make install, then source" in said[0]
    assert "make install" not in said[1]


def test_a_missing_module_of_qs3_is_not_hidden():
    with pytest.raises(ModuleNotFoundError, match="no_such_room"), needs_packages(Path()):
        import qs3.no_such_room  # noqa: F401
