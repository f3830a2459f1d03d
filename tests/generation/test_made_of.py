"""What a generated dataset says it is made of, and where it may lie beside a published one."""

import dataclasses
import shutil

import pytest

import qs3
from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError
from qs3.generation.command import generate
from qs3.generation.made_of import made_of
from qs3.generation.plan import planned
from qs3.store.meta import is_finished
from tests.fixtures.published import write_tree
from tests.generation.generating import QUICK, composed, config

FAST = [*QUICK[:-1], "views=1", "renderer.samples=1", "workers=0"]
WITHOUT = "without bathtub, bed, bookshelf, cabinet, monitor, plant, sofa"


def said_of(*words):
    plan = planned(composed(*words))
    return made_of(plan, [], plan.describe({}))


def domain(name, data_dir):
    return build(composed(f"domain={name}", f"paths.data_dir={data_dir}").domain)


def test_it_names_meshes_sensor_views_and_missing_classes(finished, meshes, tmp_path):
    seen = finished[1].made_of
    assert str(seen) == f"meshes of {meshes.name}, speckle_stereo_small, 2 views, {WITHOUT}"
    assert domain("specklenet10", finished[0].parent).made_of(finished[1]) == seen

    def samples(*more):
        shutil.rmtree(tmp_path / "modelnet10", ignore_errors=True)
        return generate(config(tmp_path, meshes, "workers=0", *more, domain="modelnet10")).made_of

    sampled = samples("scans=2")
    assert sampled.recipe not in ("", seen.recipe)
    assert sampled == dataclasses.replace(
        seen, sensor="surface samples", views=0, recipe=sampled.recipe
    )
    assert samples("half=first").meshes != seen.meshes
    filled = samples("fill_up=true", "catalogue.train=3", "catalogue.test=1")
    assert filled.objects == f"meshes of {meshes.name} and the embedded catalogue"
    assert filled.meshes != seen.meshes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["domain=specklenet10", "sensor=realsense_d415", "sensor.ambient=20"],
            "embedded catalogue, realsense_d415 with ambient=20, 5 views",
        ),
        (
            ["domain=specklenet10", "released=yes"],
            "embedded catalogue, speckle_stereo as released, 5 views",
        ),
        (["domain=modelnet10_dropout"], "embedded catalogue, surface samples with holes"),
    ],
)
def test_the_sensor_has_the_name_of_its_file(words, said):
    assert str(said_of(*words)).startswith(f"{said}, without")


PAPER = ["domain=specklenet10", "materials=principled", "light=area"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (PAPER, "principled materials, light above"),
        (
            [*PAPER, "materials.roughness=0.4", "light.ambient=0.3"],
            "principled materials with roughness=0.4, light above with ambient=0.3",
        ),
    ],
)
def test_materials_and_light_have_the_names_of_their_files_and_what_was_changed(words, said):
    assert said_of(*words).sensor == f"speckle_stereo, {said}"


def test_a_preset_beside_conf_has_the_name_of_its_file(tmp_path):
    (tmp_path / "sensor").mkdir()
    target = "_target_: qs3.sensors.devices.fitted.FittedDepth\n"
    (tmp_path / "sensor" / "my_camera.yaml").write_text(target + "noise_power: 2\n")
    words = ["domain=specklenet10", f"hydra.searchpath=[file://{tmp_path}]", "sensor=my_camera"]
    words += ["classes=[chair]", "splits=[test]", "limit=1", *FAST]
    words += [f"paths.data_dir={tmp_path}", "sensor.noise_power=1"]
    words.remove("sensor=speckle_stereo_small")
    made = qs3.generate(*words).made_of
    assert made.sensor == "my_camera with noise_power=1"


def test_an_imported_dataset_is_never_replaced(meshes, tmp_path):
    write_tree(tmp_path / "published" / "specklenet10", {"train": 1, "test": 1})
    before = domain("specklenet10", tmp_path).open().sha256
    one = ["workers=0", "limit=1", "classes=[chair]", "domain.published=null"]
    for force in ("true", "false"):
        with pytest.raises(DataError, match="generate"):
            generate(config(tmp_path, meshes, *one, f"force={force}"))
    assert domain("specklenet10", tmp_path).open().sha256 == before


def test_the_clean_twin_is_made_beside_the_published_dataset(meshes, tmp_path):
    write_tree(tmp_path / "published" / "specklenet10", {"train": 1, "test": 1})
    before = domain("specklenet10", tmp_path).open().sha256
    one = ["workers=0", "splits=[test]", "classes=[chair]"]
    made = generate(config(tmp_path, meshes, *one, domain="specklenet10_clean"))
    clean = domain("specklenet10_clean", tmp_path)
    assert clean.folder == tmp_path / "specklenet10_clean"
    assert clean.open().sha256 == made.sha256
    assert str(made.made_of).startswith(f"meshes of {meshes.name}, ")
    published = domain("specklenet10", tmp_path).open()
    assert (published.sha256, str(published.made_of)) == (before, "published files")


def test_the_clean_twin_of_a_generated_dataset_is_there_already(finished, meshes):
    folder, noisy = finished
    settings = (folder.parent, meshes, "workers=0")
    clean = generate(config(*settings, domain="specklenet10_clean"))
    assert clean.ids == noisy.ids
    assert clean.sha256 != noisy.sha256
    assert not (folder.parent / "specklenet10_clean").exists()
    with pytest.raises(ConfigError):
        generate(config(*settings, "force=true", domain="specklenet10_clean"))
    assert is_finished(folder)
