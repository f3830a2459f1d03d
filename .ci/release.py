"""A release: what must be so, the version and its date, checks, the files to publish, a tag.

    python .ci/release.py version=0.1.0             what it would do, or what stands against it
    python .ci/release.py version=0.1.0 go=true     does it; nothing is pushed or uploaded

Other keys: checks="lint test-all docs", targets of make; environment=clean, where the wheel is also
installed with its dependencies as constraints.txt pins them (PIP_ARGS is given to pip), or here, to
be content with tests/test_wheel.py, which needs no network; date=2026-01-31, else today.
"""

from __future__ import annotations

import datetime
import difflib
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import yaml

KEYS = {
    "version": "",
    "go": "false",
    "checks": "lint test-all docs",
    "environment": "clean",
    "date": "",
}
VERSION, CITATION, CHANGELOG = "qs3/utils/version.py", "CITATION.cff", "CHANGELOG.md"
FILES = Path("out/dist")
CARD = ("license", "library_name")  # what hubs read at the top of a model's card


class Refused(Exception):
    """What stands against a release."""


def run(root: Path, *words: str | Path, **more: str) -> str:
    """A command in the checkout; Refused if it fails."""
    done = subprocess.run(
        [str(word) for word in words], cwd=root, env={**os.environ, **more}, text=True,
        stdout=subprocess.PIPE, check=False,
    )  # fmt: skip
    if done.returncode:
        print(done.stdout[-3000:], file=sys.stderr)
        raise Refused(f"{' '.join(map(str, words))}: status {done.returncode}")
    return done.stdout


def problems(root: Path, version: str) -> list[str]:
    """What stands against a release of this version, as far as a look can tell."""
    found = []
    if not re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc)\d+)?", version):
        found.append(f"version={version}: expected a number such as 0.1.0 or 0.1.0rc1")
    if dirty := run(root, "git", "status", "--porcelain"):
        found.append(f"the tree is not clean, commit or remove:\n{dirty.rstrip()}")
    if run(root, "git", "tag", "--list", f"v{version}"):
        found.append(f"there is a tag v{version} already")
    if not notes(root, version):
        found.append(f"{CHANGELOG} has nothing under '## {version} (unreleased)'")
    about = yaml.safe_load((root / CITATION).read_text("utf-8"))
    if lacks := {"cff-version", "title", "message", "authors", "version"} - set(about):
        found.append(f"{CITATION} lacks {', '.join(sorted(lacks))}")
    weights = run(root, "git", "ls-files", "*.safetensors").split("\n")
    found += [why for name in weights if name and (why := without_card(root / name))]
    return found


def notes(root: Path, version: str) -> str:
    """What the changelog says of a version that is to come."""
    text = (root / CHANGELOG).read_text("utf-8")
    pattern = rf"^## {re.escape(version)} \(unreleased\)\n(.*?)(?=^## |\Z)"
    section = re.search(pattern, text, re.MULTILINE | re.DOTALL)
    return section[1].strip() if section else ""


def without_card(weights: Path) -> str:
    """What a model of the package lacks: a card, or settings that name these very tensors."""
    card, config = weights.with_name("README.md"), weights.with_name("config.json")
    head = card.read_text("utf-8").split("---\n")[1:2] if card.is_file() else []
    about = yaml.safe_load(head[0]) if head else {}
    if missing := [key for key in CARD if not (about or {}).get(key)]:
        return f"{weights}: no model card beside it, {card.name}, with {', '.join(missing)}"
    said = json.loads(config.read_text("utf-8")) if config.is_file() else {}
    key = "weights_sha256" if weights.stem == "model" else f"{weights.stem}_sha256"
    if said.get(key) != hashlib.sha256(weights.read_bytes()).hexdigest():
        return f"{weights}: {config.name} beside it names other tensors, or none"
    return ""


def changes(root: Path, version: str, date: str) -> dict[str, str]:
    """The files that name the version, as they are to be."""

    def changed(name: str, pattern: str, new: str) -> str:
        text = (root / name).read_text("utf-8")
        text, count = re.subn(pattern, new, text, flags=re.MULTILINE)
        if count != 1:
            raise Refused(f"{name}: {count} places that look like {pattern}, expected one")
        return text

    cited = r"^version: .*(\ndate-released: .*)?$"  # the date is that of the release before
    return {
        VERSION: changed(VERSION, r'^VERSION = ".*"$', f'VERSION = "{version}"'),
        CITATION: changed(CITATION, cited, f"version: {version}\ndate-released: {date}"),
        CHANGELOG: changed(
            CHANGELOG, rf"^## {re.escape(version)} \(unreleased\)$", f"## {version} ({date})"
        ),
    }


def build(root: Path, version: str, environment: str) -> list[Path]:
    """The sdist and the wheel, in out/dist, after the wheel was installed and tried."""
    run(root, sys.executable, "-m", "hatchling", "build", "-d", FILES)
    wheel = root / FILES / f"qs3-{version}-py3-none-any.whl"
    sdist = root / FILES / f"qs3-{version}.tar.gz"
    pip = ["-m", "pip", "--disable-pip-version-check", "--quiet"]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        alone = ["--no-index", "--no-deps", "--no-build-isolation"]
        run(root, sys.executable, *pip, "wheel", *alone, "-w", place, sdist)
        if _members(place / wheel.name) != _members(wheel):
            raise Refused(f"{sdist.name} does not build what {wheel.name} holds")
        tests = [sys.executable, "-m", "pytest", "-q", "-m", "", "tests/test_wheel.py"]
        run(root, *tests, QS3_WHEEL=str(wheel))
        if environment == "clean":
            run(root, sys.executable, "-m", "venv", place / "env")
            pinned = ["-c", root / "constraints.txt", *os.environ.get("PIP_ARGS", "").split()]
            run(root, place / "env" / "bin" / "python", *pip, "install", *pinned, wheel)
            for command in ("qs3", "qs3-train", "qs3-generate"):
                run(place, place / "env" / "bin" / command, "--help")
    return [sdist, wheel]


def _members(wheel: Path) -> dict[str, int]:
    with zipfile.ZipFile(wheel) as file:
        return {one.filename: one.CRC for one in file.infolist() if "dist-info" not in one.filename}


def release(root: Path, settings: dict[str, str]) -> list[str]:
    """Do it; the lines that say what is left to do. What fails leaves the tree as it was."""
    version = settings["version"]
    message = notes(root, version)
    new = changes(root, version, settings["date"])
    old = {name: (root / name).read_text("utf-8") for name in new}
    try:
        for name, text in new.items():
            (root / name).write_text(text, "utf-8")
        for target in settings["checks"].split():
            print(f"make {target}", flush=True)
            run(root, "make", target)
        print("building and trying the wheel", flush=True)
        files = build(root, version, settings["environment"])
        if odd := {*run(root, "git", "status", "--porcelain").split()[1::2]} - {*new}:
            raise Refused(f"the checks have left files in the tree: {', '.join(sorted(odd))}")
        run(root, "git", "commit", "--quiet", "-m", f"Release {version}", "--", *new)
    except BaseException:
        for name, text in old.items():
            (root / name).write_text(text, "utf-8")
        raise
    run(root, "git", "tag", "--annotate", f"v{version}", "-m", f"qs3 {version}\n\n{message}")
    return [
        f"tagged v{version}; left to do, if it is to be published:",
        f"  git push origin HEAD v{version}",
        f"  python -m twine upload {' '.join(str(file.relative_to(root)) for file in files)}",
    ]


def plan(root: Path, settings: dict[str, str]) -> list[str]:
    """What `release` would do, in lines."""
    version = settings["version"]
    lines = ["Nothing stands against it. With go=true, in this order:"]
    for name, text in changes(root, version, settings["date"]).items():
        old = (root / name).read_text("utf-8").splitlines()
        found = [line for line in difflib.ndiff(old, text.splitlines()) if line[0] in "-+"]
        lines += [f"  {name}:", *(f"    {line}" for line in found or ["as it is"])]
    lines += [f"  make {target}" for target in settings["checks"].split()]
    clean = " and in a clean environment" * (settings["environment"] == "clean")
    return [
        *lines,
        f"  {FILES}/qs3-{version}.tar.gz and qs3-{version}-py3-none-any.whl: built, compared",
        f"  the wheel is installed and tried by tests/test_wheel.py{clean}",
        f'  git commit -m "Release {version}"; git tag v{version}, with what {CHANGELOG} says',
        "Nothing is pushed or uploaded.",
    ]


def main(root: Path, *words: str) -> int:
    """The exit status."""
    given = dict(word.partition("=")[::2] for word in words)
    settings = {**KEYS, "date": datetime.date.today().isoformat(), **given}
    if set(given) - set(KEYS) or not settings["version"] or settings["go"] not in ("true", "false"):
        print(__doc__, file=sys.stderr)
        return 2
    try:
        if found := problems(root, settings["version"]):
            raise Refused("\n".join(found))
        if settings["go"] == "true":
            print("\n".join(release(root, settings)))
        else:
            print("\n".join(plan(root, settings)))
    except Refused as error:
        print(f"no release: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[1], *sys.argv[1:]))
