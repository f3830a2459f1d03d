"""Every domain that can be generated composes, instantiates, and says what it needs."""

import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from qs3 import quickstart
from qs3.classes import CLASSES
from qs3.generation_plan import benchmark, check, describe, mesh_items
from qs3.hydra_glue import build

ROOT = Path(__file__).resolve().parents[2]
DOMAINS = ("specklenet10", "specklenet10_clean", "modelnet10", "modelnet10_dropout", "kinectsim10")


def config(*overrides, name="generate"):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose(name, list(overrides))


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_domain_has_a_recipe_and_all_ten_classes(domain):
    cfg = config(f"domain={domain}")
    check(cfg)
    recipe = build(cfg.recipe)
    assert recipe.points == 2048
    items = mesh_items(cfg)
    assert {item.cls for item in items} == set(CLASSES)
    assert {item.split for item in items} == {"train", "test"}
    assert len({item.id for item in items}) == len(items)


def test_the_papers_settings_are_the_defaults_of_the_papers_dataset():
    cfg = config("domain=specklenet10")
    assert cfg.renderer.name == "blender"
    recipe = build(cfg.recipe)
    sensor = recipe.sensor
    assert (sensor.width_px, sensor.height_px) == (1080, 1080)
    assert sensor.width_px // sensor.step_px == 270
    assert sensor.baseline_m == 0.1
    assert (recipe.views.min_distance_m, recipe.views.max_distance_m) == (3, 5)
    assert (recipe.views.min_elevation_deg, recipe.views.max_elevation_deg) == (20, 50)
    assert (recipe.views.max_shift_m, recipe.views.max_turn_rad) == (0.1, 0.1)
    assert recipe.views.count == 5


def test_source_and_stand_in_share_no_mesh_no_pattern_no_matcher_and_no_noise():
    source, target = config("domain=specklenet10"), config("domain=kinectsim10")
    assert source.catalogue.seed != target.catalogue.seed
    a, b = (build(cfg.recipe).sensor for cfg in (source, target))
    assert a.pattern.seed != b.pattern.seed
    assert type(a.matcher) is not type(b.matcher)
    assert a.infrared.electrons_at_white != b.infrared.electrons_at_white
    assert a.infrared.read_noise_e != b.infrared.read_noise_e
    hashes = [
        {item.load().sha256 for item in mesh_items(config(f"domain={name}", "limit=2"))}
        for name in ("specklenet10", "kinectsim10")
    ]
    assert not hashes[0] & hashes[1]


def test_the_stand_in_has_the_class_frequencies_of_scannet10():
    scannet = dict(zip(CLASSES, (98, 329, 464, 650, 2578, 161, 210, 88, 495, 1037), strict=True))
    train = config("domain=kinectsim10").catalogue.train
    for name, count in scannet.items():
        assert train[name] == max(12, round(count / 10))


def plan(*overrides):
    cfg = config("domain=kinectsim10", *overrides)
    return benchmark(cfg, describe(cfg, mesh_items(cfg), {}))


def test_the_benchmark_knows_itself():
    """A change of any setting is another version: give it a new number and a new hash."""
    assert plan() == "kinectsim10 v1"
    assert plan("renderer.threads=2", "renderer.variant=scalar_rgb", "workers=1") == plan()
    for other in ("fraction=0.5", "views=3", "renderer.samples=4", "recipe.min_points=100"):
        assert plan(other).startswith("like kinectsim10 v1, but not it")


def test_smaller_keeps_the_frequencies():
    whole = mesh_items(config("domain=kinectsim10"))
    part = mesh_items(config("domain=kinectsim10", "fraction=0.25"))
    part_ids = [item.id for item in part]
    assert set(part_ids) <= {item.id for item in whole}
    chairs = sum(name.startswith("chair/train") for name in part_ids)
    assert chairs == 65  # a quarter of 258, rounded up
    several = mesh_items(config("domain=kinectsim10", "fraction=0.25", "scans=3"))
    assert len(several) == 3 * len(part)


def test_a_misspelt_key_is_an_error():
    with pytest.raises(Exception, match="samplez"):
        config("renderer.samplez=3")
    with pytest.raises(Exception, match="veiws"):
        config("veiws=3")


def test_every_command_of_the_quickstart_composes():
    for command in quickstart.DATASETS:
        check(config(*command.split()[1:]))
    for row in OmegaConf.load(quickstart.TABLE).rows:
        cfg = config(*row["target test"]["run"].split(), name="train")
        assert cfg.experiment_name == "quickstart"


def test_quickstart_starts():
    done = subprocess.run(
        [sys.executable, "-m", "qs3.quickstart", "--help"], cwd=ROOT, capture_output=True,
        text=True, timeout=60, check=True,
    )  # fmt: skip
    assert "--out" in done.stdout


def test_help_is_short_and_answers_quickly():
    done = subprocess.run(
        [sys.executable, "generate.py", "--help"], cwd=ROOT, capture_output=True, text=True,
        timeout=60, check=True,
    )  # fmt: skip
    assert "domain=specklenet10" in done.stdout
    assert "meshes=PATH" in done.stdout
    assert len(done.stdout.splitlines()) < 30
