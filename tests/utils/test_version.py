"""The commit of a checkout, which results carry."""

import os
import subprocess

import pytest

from qs3.utils import version

AS_SOMEBODY = ["-c", "user.name=a", "-c", "user.email=a@b"]


def git(folder, *words):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    done = subprocess.run(
        ["git", *AS_SOMEBODY, *words], cwd=folder, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return done.stdout.strip()


@pytest.fixture
def commit(monkeypatch):
    """`version.commit` of a folder."""

    def of(folder):
        monkeypatch.setattr(version, "_CHECKOUT", folder)
        return version.commit.__wrapped__()

    return of


def test_a_checkout_says_its_commit_and_whether_it_was_changed(tmp_path, commit, monkeypatch):
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere"))  # as a hook of git sets it
    git(tmp_path, "init", "--quiet")
    assert commit(tmp_path) == ""  # nothing is committed
    (tmp_path / "a.py").write_text("1")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "--quiet", "--message", "a")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert len(commit(tmp_path)) >= 12
    assert head.startswith(commit(tmp_path))
    (tmp_path / "new.txt").write_text("a note beside it")
    assert commit(tmp_path)[-1] != "+"
    (tmp_path / "a.py").write_text("2")
    assert commit(tmp_path)[-1] == "+"
    inner = tmp_path / ".venv" / "site-packages"  # an installed package in such a checkout
    inner.mkdir(parents=True)
    assert commit(inner) == ""
