"""What decides a dataset's bytes, in digits: what changes them, and what must not."""

import copy
import re
import shutil
from pathlib import Path

import pytest

import qs3
from qs3.generation.plan import MAKES_CLOUDS, code_fingerprint, planned, recipe_fingerprint
from tests.generation.generating import config

MADE = ["chair/train/a", "chair/train/b"]
VERSIONS = {"renderer": "mitsuba", "mitsuba": "3.9.1", "llvm": "15", "width": "8", "machine": "a"}
HARMLESS = ("cluster", "config", "store", "datasets", "errors", "utils")
"""What makes no cloud: it reads settings, stores or shows."""

COVERED = tuple(f"qs3.{name.removesuffix('.py').replace('/', '.')}" for name in MAKES_CLOUDS)
ROOT = Path(qs3.__file__).parent


@pytest.fixture(scope="module")
def recipe(meshes, tmp_path_factory):
    described = planned(config(tmp_path_factory.mktemp("data"), meshes)).describe({})
    return {**described, "versions": VERSIONS}


def changed(recipe, **versions):
    return recipe_fingerprint({**recipe, "versions": {**VERSIONS, **versions}}, MADE)


def test_settings_objects_and_libraries_matter_and_the_machine_does_not(recipe):
    digits = recipe_fingerprint(recipe, MADE)
    assert re.fullmatch("[0-9a-f]{12}", digits)
    assert changed(recipe, machine="aarch64", llvm="19", width="16") == digits
    assert recipe_fingerprint(recipe, MADE[::-1]) == digits
    other = copy.deepcopy(recipe)
    other["settings"]["recipe"]["points"] = 1024
    seen = {digits, changed(recipe, mitsuba="4.0.0"), recipe_fingerprint(other, MADE)}
    seen.add(recipe_fingerprint({**recipe, "objects": recipe["objects"][1:]}, MADE))
    seen.add(recipe_fingerprint(recipe, MADE[1:]))  # one failed on this machine
    assert len(seen) == 5


@pytest.fixture
def code(tmp_path):
    """A copy of the packages, in which a test may change a file."""
    for name in MAKES_CLOUDS:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".py"):
            shutil.copy(ROOT / name, tmp_path / name)
        else:
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("*.pyc"))
    return tmp_path


def test_so_does_code_but_not_words(code, monkeypatch):
    assert code_fingerprint(code) == code_fingerprint()
    monkeypatch.setattr("qs3.generation.plan.MAKES_CLOUDS", ("meshes", "sensors/optics"))
    digits = code_fingerprint.__wrapped__(code)
    file = code / "sensors" / "optics" / "patterns.py"
    text = file.read_text()
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Words."""\n    return 1  # a comment\n')
    with_function = code_fingerprint.__wrapped__(code)
    assert with_function != digits
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Other words."""\n    return 1\n')
    assert code_fingerprint.__wrapped__(code) == with_function
    file.write_text(f"{text}\n\ndef _f() -> int:\n    return 2\n")
    assert code_fingerprint.__wrapped__(code) not in (digits, with_function)


def test_all_that_makes_clouds_is_in_it():
    """What its modules import from elsewhere in qs3, and what configs of generation name."""
    harmless = tuple(f"qs3.{name}" for name in HARMLESS)
    for name in MAKES_CLOUDS:
        files = [ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*.py")
        for path in files:
            for module in re.findall(r"^from (qs3\.[\w.]+) import", path.read_text(), re.MULTILINE):
                assert module.startswith((*COVERED, *harmless)), f"{path}: {module}"
    groups = (
        *("synthesis", "sensor", "renderer", "scene", "tracking", "crop", "materials", "light"),
        "released",
    )
    conf = ROOT.parent / "conf"
    text = "\n".join(f.read_text("utf-8") for g in groups for f in (conf / g).rglob("*.yaml"))
    named = set(re.findall(r"_target_: (qs3\.[\w.]+)", text))
    assert len(named) > 20
    assert [name for name in sorted(named) if not name.startswith(COVERED)] == []
