"""Digits of a recipe: what changes them, and what must not."""

import copy
import shutil
from pathlib import Path

import pytest

import qs3
from qs3.data.store import open_pointset
from qs3.generation.code_digits import code_digits
from qs3.generation.command import generate
from qs3.generation.plan import describe, mesh_items
from qs3.generation.recipe_digits import recipe_digits
from tests.generation.generating import config

VERSIONS = {"renderer": "mitsuba", "mitsuba": "3.9.1", "llvm": "15", "width": "8", "machine": "a"}


@pytest.fixture(scope="module")
def recipe(meshes, tmp_path_factory):
    cfg = config(tmp_path_factory.mktemp("data"), meshes)
    return {**describe(cfg, mesh_items(cfg), {}), "versions": VERSIONS}


def changed(recipe, **versions):
    return recipe_digits({**recipe, "versions": {**VERSIONS, **versions}})


def test_the_machine_does_not_matter(recipe):
    digits = recipe_digits(recipe)
    assert len(digits) == 12
    assert int(digits, 16) >= 0
    assert changed(recipe, machine="aarch64", llvm="19", width="16") == digits


def test_settings_objects_and_libraries_do(recipe):
    seen = {recipe_digits(recipe), changed(recipe, mitsuba="4.0.0")}
    other = copy.deepcopy(recipe)
    other["settings"]["recipe"]["points"] = 1024
    seen.add(recipe_digits(other))
    seen.add(recipe_digits({**recipe, "objects": recipe["objects"][1:]}))
    assert len(seen) == 4


@pytest.fixture
def code(tmp_path):
    """A copy of the packages, in which a test may change a file."""
    root = Path(qs3.__file__).parent
    for package in ("clouds", "generation", "geometry", "meshes", "sensors"):
        shutil.copytree(root / package, tmp_path / package, ignore=shutil.ignore_patterns("*.pyc"))
    return tmp_path


def test_so_does_code_but_not_words(code):
    digits = code_digits()
    assert code_digits(code) == digits
    file = code / "sensors" / "optics" / "patterns.py"
    text = file.read_text()
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Words."""\n    return 1  # a comment\n')
    with_function = code_digits.__wrapped__(code)
    assert with_function != digits
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Other words."""\n    return 1\n')
    assert code_digits.__wrapped__(code) == with_function
    file.write_text(f"{text}\n\ndef _f() -> int:\n    return 2\n")
    assert code_digits.__wrapped__(code) not in (digits, with_function)
    file.rename(file.with_name("pattern.py"))
    file.with_name("pattern.py").write_text(text)
    assert code_digits.__wrapped__(code) != digits  # a module's name is what others import


def test_a_dataset_holds_them(meshes, tmp_path):
    cfg = config(tmp_path, meshes, "workers=0", domain="modelnet10")
    made = generate(cfg).made_of
    assert len(made.recipe) == 12
    assert open_pointset(tmp_path / "modelnet10").made_of == made
    again = generate(
        config(tmp_path, meshes, "workers=0", "scans=2", "force=true", domain="modelnet10")
    )
    assert again.made_of.meshes == made.meshes
    assert again.made_of.recipe != made.recipe
    assert made.recipe not in str(made)  # for programs: people see the meshes' name
