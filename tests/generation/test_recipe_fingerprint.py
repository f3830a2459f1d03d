"""Digits of a recipe: what changes them, and what must not."""

import copy
import re
import shutil
from pathlib import Path

import pytest

import qs3
from qs3.generation.code_fingerprint import HARMLESS, MAKES_CLOUDS, code_fingerprint
from qs3.generation.command import generate
from qs3.generation.objects import mesh_items
from qs3.generation.plan import describe
from qs3.generation.recipe_fingerprint import recipe_fingerprint
from qs3.store.store import open_pointset
from tests.generation.generating import config

MADE = ["chair/train/a", "chair/train/b"]
VERSIONS = {"renderer": "mitsuba", "mitsuba": "3.9.1", "llvm": "15", "width": "8", "machine": "a"}


@pytest.fixture(scope="module")
def recipe(meshes, tmp_path_factory):
    cfg = config(tmp_path_factory.mktemp("data"), meshes)
    return {**describe(cfg, mesh_items(cfg), {}), "versions": VERSIONS}


def changed(recipe, **versions):
    return recipe_fingerprint({**recipe, "versions": {**VERSIONS, **versions}}, MADE)


def test_the_machine_does_not_matter(recipe):
    digits = recipe_fingerprint(recipe, MADE)
    assert len(digits) == 12
    assert int(digits, 16) >= 0
    assert changed(recipe, machine="aarch64", llvm="19", width="16") == digits


def test_settings_objects_and_libraries_do(recipe):
    seen = {recipe_fingerprint(recipe, MADE), changed(recipe, mitsuba="4.0.0")}
    other = copy.deepcopy(recipe)
    other["settings"]["recipe"]["points"] = 1024
    seen.add(recipe_fingerprint(other, MADE))
    seen.add(recipe_fingerprint({**recipe, "objects": recipe["objects"][1:]}, MADE))
    seen.add(recipe_fingerprint(recipe, MADE[1:]))  # one failed on this machine
    assert len(seen) == 5
    assert recipe_fingerprint(recipe, MADE[::-1]) in seen


@pytest.fixture
def code(tmp_path):
    """A copy of the packages, in which a test may change a file."""
    root = Path(qs3.__file__).parent
    for name in MAKES_CLOUDS:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".py"):
            shutil.copy(root / name, tmp_path / name)
        else:
            shutil.copytree(root / name, tmp_path / name, ignore=shutil.ignore_patterns("*.pyc"))
    return tmp_path


def test_so_does_code_but_not_words(code):
    digits = code_fingerprint()
    assert code_fingerprint(code) == digits
    file = code / "sensors" / "optics" / "patterns.py"
    text = file.read_text()
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Words."""\n    return 1  # a comment\n')
    with_function = code_fingerprint.__wrapped__(code)
    assert with_function != digits
    file.write_text(f'{text}\n\ndef _f() -> int:\n    """Other words."""\n    return 1\n')
    assert code_fingerprint.__wrapped__(code) == with_function
    file.write_text(f"{text}\n\ndef _f() -> int:\n    return 2\n")
    assert code_fingerprint.__wrapped__(code) not in (digits, with_function)
    file.rename(file.with_name("pattern.py"))
    file.with_name("pattern.py").write_text(text)
    assert code_fingerprint.__wrapped__(code) != digits  # a module's name is what others import


def test_all_that_makes_clouds_is_in_it():
    """What its modules import from elsewhere in qs3 is a part of it, too, or known as harmless."""
    root = Path(qs3.__file__).parent
    covered = tuple(f"qs3.{name.removesuffix('.py').replace('/', '.')}" for name in MAKES_CLOUDS)
    harmless = tuple(f"qs3.{name}" for name in HARMLESS)
    for name in MAKES_CLOUDS:
        files = [root / name] if name.endswith(".py") else (root / name).rglob("*.py")
        for path in files:
            for module in re.findall(r"^from (qs3\.[\w.]+) import", path.read_text(), re.MULTILINE):
                assert module.startswith((*covered, *harmless)), f"{path}: {module}"
    # Of what is harmless, these decide something, and are in it by name.
    assert {"qs3.utils.seeding", "qs3.datasets.frames"} <= set(covered)


def test_all_that_a_config_of_generation_names_is_in_it():
    """A class that no module imports makes clouds by its name in a config."""
    conf = Path(qs3.__file__).parents[1] / "conf"
    groups = (
        *("synthesis", "sensor", "renderer", "scene", "tracking", "crop", "materials", "light"),
        *("depth_errors", "released", "cutting", "counts"),
    )
    files = [file for group in groups for file in (conf / group).rglob("*.yaml")]
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    named = set(re.findall(r"_target_: (qs3\.[\w.]+)", text))
    assert len(named) > 20
    covered = tuple(f"qs3.{name.removesuffix('.py').replace('/', '.')}." for name in MAKES_CLOUDS)
    assert [name for name in sorted(named) if not name.startswith(covered)] == []


def test_what_makes_no_cloud_is_not_in_it():
    """Else a faster net, or a better fit, would keep runs of the same clouds apart."""
    covered = tuple(f"qs3.{name.removesuffix('.py').replace('/', '.')}" for name in MAKES_CLOUDS)
    others = ("geometry.neighbours", "geometry.numba_kernels", "sensors.fit", "sensors.bench")
    assert not [name for name in others if f"qs3.{name}".startswith(covered)]


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
