"""A release is refused, told and made as `.ci/release.py` says, in real repositories."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / ".ci" / "release.py"
NAMED = ("qs3/utils/version.py", "CITATION.cff", "CHANGELOG.md")
AUTHOR = {
    f"GIT_{who}_{what}": "a@b.c" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")
}
MAKEFILE = "%:\n\t@echo $@ >> out/made; test '$@' != '$(RED)'\n"
CARD = "---\nlicense: mit\nlibrary_name: qs3\n---\n# A model\n"

pytestmark = pytest.mark.skipif(not SCRIPT.is_file(), reason="an sdist is not released from")


def git(root: Path, *words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=root, env={**os.environ, **AUTHOR}, check=True, text=True,
        capture_output=True,
    ).stdout  # fmt: skip


@pytest.fixture
def release(monkeypatch):
    for key, value in AUTHOR.items():
        monkeypatch.setenv(key, value)
    spec = importlib.util.spec_from_file_location("release", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def root(tmp_path):
    """A repository with what the script looks at; its Makefile notes what was made."""
    folder = tmp_path / "repository"
    for name in NAMED:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    # As before a first release, whatever is the state of this tree.
    (folder / "CHANGELOG.md").write_text("# Changelog\n\n## 0.1.0 (unreleased)\n\n- All of it.\n")
    (folder / "Makefile").write_text(MAKEFILE)
    (folder / ".gitignore").write_text("/out/\n")
    git(folder, "init", "--quiet")
    commit(folder)
    return folder


def commit(folder: Path) -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "more")


def state(folder: Path) -> tuple[str, ...]:
    """What a release that is refused must leave as it was."""
    return (
        git(folder, "rev-parse", "HEAD"),
        git(folder, "tag"),
        git(folder, "status", "--porcelain"),
    )


def test_without_go_it_says_what_it_would_do_and_does_nothing(release, root, capsys):
    before = state(root)
    assert release.main(root, "version=0.1.0", "date=2026-01-31") == 0
    said = capsys.readouterr().out
    for words in ("+ ## 0.1.0 (2026-01-31)", "+ date-released: 2026-01-31", "make test-all",
                  "qs3-0.1.0-py3-none-any.whl", "git tag v0.1.0", "Nothing is pushed"):  # fmt: skip
        assert words in said
    assert state(root) == before
    assert not (root / "out").exists()


def dirty(root):
    (root / "new.txt").write_text("x")
    return "new.txt"


def tagged(root):
    git(root, "tag", "v0.1.0")
    return "a tag v0.1.0 already"


def silent(root):
    (root / "CHANGELOG.md").write_text("## 0.1.0 (unreleased)\n\n## 0.0.9\n\n- x\n")
    commit(root)
    return "nothing under '## 0.1.0"


def uncited(root):
    text = (root / "CITATION.cff").read_text()
    (root / "CITATION.cff").write_text(re.sub(r"(?m)^title: .*\n", "", text))
    commit(root)
    return "CITATION.cff lacks title"


def without_card(root):
    (root / "model").mkdir()
    (root / "model" / "model.safetensors").write_bytes(b"weights")
    commit(root)
    return "no model card beside it, README.md, with license, library_name"


def other_weights(root):
    without_card(root)
    (root / "model" / "README.md").write_text(CARD)
    (root / "model" / "config.json").write_text('{"weights_sha256": "0"}')
    commit(root)
    return "names other tensors"


@pytest.mark.parametrize("against", [dirty, tagged, silent, uncited, without_card, other_weights])
def test_what_stands_against_it_is_said(release, root, capsys, against):
    words, before = against(root), state(root)
    for go in ("false", "true"):
        assert release.main(root, "version=0.1.0", f"go={go}") == 1
        assert words in capsys.readouterr().err
    assert state(root) == before
    assert not (root / "out").exists()


@pytest.mark.parametrize(
    ("words", "status"),
    [((), 2), (("version=0.1.0", "push=true"), 2), (("version=0.1.0", "go=yes"), 2),
     (("version=one",), 1), (("version=v0.1.0",), 1)],
)  # fmt: skip
def test_other_words_are_refused(release, root, words, status):
    assert release.main(root, *words) == status


def test_models_with_a_card_and_their_own_weights_are_let_through(release, root, capsys):
    without_card(root)
    digest = hashlib.sha256(b"weights").hexdigest()
    (root / "model" / "README.md").write_text(CARD)
    hashes = {"weights_sha256": digest}
    for name in ("held_out", "trained_norms"):
        (root / "model" / f"{name}.safetensors").write_bytes(name.encode())
        hashes[f"{name}_sha256"] = hashlib.sha256(name.encode()).hexdigest()
    (root / "model" / "config.json").write_text(json.dumps(hashes))
    commit(root)
    assert release.main(root, "version=0.1.0") == 0, capsys.readouterr().err


def test_a_red_check_leaves_all_as_it_was(release, root, capsys, monkeypatch):
    monkeypatch.setenv("RED", "test")
    (root / "out").mkdir()
    before = state(root)
    assert release.main(root, "version=0.1.0", "go=true", "checks=lint test docs") == 1
    assert "make test: status 2" in capsys.readouterr().err
    assert (root / "out" / "made").read_text().split() == ["lint", "test"]
    assert state(root) == before


@pytest.mark.slow
def test_a_release_of_this_very_tree(release, tmp_path, capsys):
    """With checks that pass; nothing reaches the repository it was cloned from."""
    (tmp_path / "made").mkdir()
    tree, origin = tmp_path / "tree", tmp_path / "origin"
    names = [".git", ".venv", "out", "logs", "wandb", "__pycache__", ".*_cache", ".hypothesis"]
    shutil.copytree(ROOT, origin, ignore=shutil.ignore_patterns(*names))
    (origin / "CHANGELOG.md").write_text("# Changelog\n\n## 9.9.9 (unreleased)\n\n- All of it.\n")
    (origin / "Makefile").write_text(MAKEFILE.replace("out/made", f"{tmp_path}/made/by"))
    git(origin, "init", "--quiet")
    commit(origin)
    git(tmp_path, "clone", "--quiet", str(origin), "tree")
    before = state(origin)
    words = [
        "version=9.9.9",
        "go=true",
        "checks=lint test-all",
        "environment=here",
        "date=2026-01-31",
    ]
    assert release.main(tree, *words) == 0, capsys.readouterr().err
    assert "git push origin HEAD v9.9.9" in capsys.readouterr().out
    assert (tmp_path / "made" / "by").read_text().split() == ["lint", "test-all"]
    assert git(tree, "tag", "--list", "--format=%(objecttype) %(contents)").split("\n")[:3] == [
        "tag qs3 9.9.9", "", "- All of it.",
    ]  # fmt: skip
    assert git(tree, "status", "--porcelain") == ""
    assert set(git(tree, "diff", "--name-only", "HEAD~1").split()) == set(NAMED)
    assert state(origin) == before
    cited = yaml.safe_load((tree / "CITATION.cff").read_text())
    assert (cited["version"], str(cited["date-released"])) == ("9.9.9", "2026-01-31")
    with zipfile.ZipFile(tree / "out/dist/qs3-9.9.9-py3-none-any.whl") as wheel:
        assert b'VERSION = "9.9.9"' in wheel.read("qs3/utils/version.py")
    assert (tree / "out/dist/qs3-9.9.9.tar.gz").is_file()
    assert release.main(tree, *words) == 1  # a second time


# ---- what hosts run on pull requests ----


def scripts(name: str) -> list[str]:
    text = (ROOT / ".ci" / name).read_text("utf-8")
    found = yaml.safe_load(text)
    if name == "gitlab.yml":
        return found["checks"]["script"]
    return [step["run"] for step in found["jobs"]["checks"]["steps"] if "run" in step]


@pytest.mark.parametrize("name", ["github.yml", "gitlab.yml"])
def test_hosts_install_and_run_what_ci_runs(name):
    commands = scripts(name)
    assert [line.split(" #")[0].removeprefix("sudo ") for line in commands] == [
        "make install", ".venv/bin/qs3 doctor install=true", ".ci/run", "make docs",
    ]  # fmt: skip
    for line in commands:
        subprocess.run(["bash", "-n", "-c", line], check=True)
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {"install", "docs", "lint", "test", "test-all", "release"} <= set(targets)


def test_hosts_have_the_python_that_is_needed():
    major, minor = sys.version_info[:2]
    text = (ROOT / ".ci" / "github.yml").read_text("utf-8")
    loaded = yaml.load(text, yaml.BaseLoader)  # its `on` is not a boolean
    assert set(loaded["on"]) == {"pull_request", "push"}
    setup = next(
        one for one in loaded["jobs"]["checks"]["steps"] if "python" in one.get("uses", "")
    )
    assert setup["with"]["python-version"] == f"{major}.{minor}"
    image = yaml.safe_load((ROOT / ".ci" / "gitlab.yml").read_text("utf-8"))["checks"]["image"]
    assert image.startswith(f"python:{major}.{minor}-")
