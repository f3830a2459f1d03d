"""Every domain that can be generated composes, instantiates, and says what it needs."""

import re
from collections import Counter

import pytest
from omegaconf import OmegaConf

from qs3.classes import CLASSES
from qs3.errors import ConfigError
from qs3.generation.camera_poses import AnchoredViews
from qs3.generation.plan import planned
from qs3.generation.scenes import Alone, Room
from tests.generation.generating import composed as config

DOMAINS = (
    *("specklenet10", "specklenet10_clean", "blensor10", "kinectsim10"),
    *("modelnet10", "modelnet10_dropout"),
    *("specklenet10_view", "rooms10", "kinectsim10_full", "kinectsim10_shifted"),
)


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_domain_has_a_recipe_and_all_ten_classes(domain):
    plan = planned(config(f"domain={domain}"))
    assert plan.recipe.points == (1024 if domain == "rooms10" else 2048)
    items = plan.items
    assert {item.cls for item in items} == set(CLASSES)
    assert {item.split for item in items} == {"train", "test"}
    assert len({item.id for item in items}) == len(items)


def test_the_papers_settings_are_the_defaults_of_the_papers_dataset():
    cfg = config("domain=specklenet10")
    recipe = planned(cfg).recipe
    sensor = recipe.sensor
    assert (sensor.width_px, sensor.height_px) == (1080, 1080)
    assert sensor.width_px // sensor.step_px == 270
    assert sensor.baseline_m == 0.1
    assert recipe.views == AnchoredViews(5, 3, 5, 20, 50, 0.1, 0.1)


def test_source_and_stand_in_share_no_mesh_no_pattern_no_matcher_and_no_noise():
    source, target = config("domain=specklenet10"), config("domain=kinectsim10")
    assert source.catalogue.seed != target.catalogue.seed
    a, b = (planned(cfg).recipe.sensor for cfg in (source, target))
    assert a.pattern.seed != b.pattern.seed
    assert type(a.matcher) is not type(b.matcher)
    assert a.infrared.electrons_at_white != b.infrared.electrons_at_white
    assert a.infrared.read_noise_e != b.infrared.read_noise_e
    hashes = [
        {item.load().sha256 for item in mesh_items(config(f"domain={name}", "limit=1"))}
        for name in ("specklenet10", "kinectsim10")
    ]
    assert not hashes[0] & hashes[1]


def mesh_items(cfg):
    return planned(cfg).items


def benchmark(*words, domain="kinectsim10"):
    plan = planned(config(f"domain={domain}", *words))
    return plan.benchmark(plan.describe({}))


def test_benchmarks_know_themselves_and_their_parts():
    """A change of any setting is another version: give it a new number and a new hash.

    The objects of a part are those of the whole, byte for byte: each has a seed of its own.
    """
    assert benchmark() == "kinectsim10 v3"
    assert benchmark("renderer.threads=2", "renderer.variant=scalar_rgb") == "kinectsim10 v3"
    for other in ("fraction=0.5", "views=3", "renderer.samples=16", "recipe.min_points=100"):
        assert benchmark(other).startswith("kinectsim10 v3 with other")
    assert benchmark("splits=[train]", other).startswith("kinectsim10 v3 with other")
    assert benchmark("splits=[train]") == "kinectsim10 v3, train"
    assert benchmark(domain="rooms10") == "rooms10 v2"
    assert benchmark("recipe.by_class=0", domain="rooms10").startswith("rooms10 v2 with")
    assert benchmark(domain="kinectsim10_full") == "kinectsim10_full v2"
    assert benchmark(domain="kinectsim10_shifted") == "kinectsim10_shifted v1"


def own_meshes(root, **counts):
    """Empty files with names as in ModelNet: nothing is opened."""
    for cls, n in counts.items():
        for split in ("train", "test"):
            (root / cls / split).mkdir(parents=True)
            for i in range(n):
                (root / cls / split / f"{cls}_{i:04d}.off").touch()
    return f"meshes={root}"


def test_the_catalogue_fills_up_what_own_meshes_lack(tmp_path):
    own = own_meshes(tmp_path, chair=3, table=20)
    words = ("domain=modelnet10", own, "fill_up=true", "scans=2", "up=z")
    counts = {**dict.fromkeys(CLASSES, 1), "chair": 10, "plant": 0, "table": 30}
    given = ", ".join(f"{name}: {n}" for name, n in counts.items())
    items = mesh_items(config(*words, f"catalogue.train={{{given}}}", "catalogue.test=6"))
    of = Counter((item.cls, item.split, item.path is not None) for item in items)
    assert of["chair", "train", True] == 6  # three meshes, scanned twice
    assert of["chair", "train", False] == 4
    assert of["chair", "test", False] == 0  # six are there
    assert of["table", "train", True] == 40  # more than the catalogue has: all of them
    assert of["table", "train", False] == 0
    assert of["lamp", "train", False] == 1  # a class without a folder
    assert of["plant", "test", False] == 6
    assert len({item.id for item in items}) == len(items)  # chair_0000 is there twice
    assert [item.cls for item in items] == sorted((i.cls for i in items), key=CLASSES.index)
    # They are the catalogue's first, whatever their new names.
    plain = {i.id: i.origin for i in mesh_items(config("domain=modelnet10"))}
    added = [item for item in items if item.path is None]
    assert all(item.id.count("/catalogue-") == 1 for item in added)
    assert all(plain[i.id.replace("/catalogue-", "/")] == i.origin for i in added)
    # Small, and in parts.
    small = mesh_items(config(*words, "limit=5", "splits=[train]"))
    assert Counter(item.cls for item in small) == {
        **dict.fromkeys(CLASSES, 5),
        "chair": 6,
        "table": 10,
    }


def test_rooms_have_the_classes_of_the_meshes_that_are_given(tmp_path):
    own = own_meshes(tmp_path, Chair=3, mug=2)
    plan = planned(config("domain=rooms10", own))
    assert plan.domain.names == plan.classes == ("chair", "mug")
    assert Counter((item.cls, item.split) for item in plan.items)["mug", "train"] == 2
    assert planned(config("domain=rooms10", own, "classes=[mug]")).classes == ("mug",)
    ten = own_meshes(tmp_path / "ten", **dict.fromkeys(CLASSES, 1))
    assert planned(config("domain=rooms10", ten)).domain.classes is None


def settings_of(*words):
    return planned(config(*words))._settings()


def test_halves_that_are_filled_up_share_no_object_of_the_catalogue(tmp_path):
    own = own_meshes(tmp_path, chair=4, lamp=1)
    (tmp_path / "table" / "train").mkdir(parents=True)  # empty: as if it were not there
    classes = ("chair", "lamp", "monitor", "table")
    words = ("domain=modelnet10", own, "fill_up=true", "up=z", "limit=3", "splits=[train]")
    words += (f"classes=[{','.join(classes)}]",)

    def made(half):
        items = mesh_items(config(*words, f"half={half}"))
        assert Counter(item.cls for item in items) == dict.fromkeys(classes, 3)
        return {item.load().sha256 for item in items if item.path is None}

    first, second = made("first"), made("second")
    assert len(first) == 12 - 3
    assert not first & second
    plans = [settings_of(*words, f"half={half}")["meshes"] for half in ("first", "second")]
    assert plans[0] != plans[1]
    assert settings_of(*words, "half=all", "fill_up=false")["meshes"] == "folder"


def test_smaller_keeps_the_frequencies():
    whole = mesh_items(config("domain=kinectsim10"))
    part = mesh_items(config("domain=kinectsim10", "fraction=0.25"))
    part_ids = [item.id for item in part]
    assert set(part_ids) <= {item.id for item in whole}
    chairs = sum(name.startswith("chair/train") for name in part_ids)
    assert chairs == 65  # a quarter of 258, rounded up
    several = mesh_items(config("domain=kinectsim10", "fraction=0.25", "scans=3"))
    assert len(several) == 3 * len(part)


@pytest.mark.parametrize(
    ("domain", "scene", "tracking", "crop"),
    [("kinectsim10", "alone", "exact", "box"), ("specklenet10", "room", "drifting", "mask")],
)
def test_scene_tracking_and_crop_go_with_every_domain_that_looks(domain, scene, tracking, crop):
    """Each domain with what is the other's own."""
    cfg = config(f"domain={domain}", f"scene={scene}", f"tracking={tracking}", f"crop={crop}")
    recipe = planned(cfg).recipe
    assert type(recipe.scene) is {"alone": Alone, "room": Room}[scene]
    assert (recipe.drift.shift_m > 0) == (tracking == "drifting")
    assert type(recipe.crop).__name__.lower() == f"{crop}crop"


def stored(cfg):
    return planned(cfg).stored_config()


def test_meta_holds_the_whole_config_but_places_and_what_changes_no_byte():
    overrides = ("domain=specklenet10", "limit=3", "scene=room")
    meta = stored(config(*overrides, "meshes=/mine", "workers=3", "paths.data_dir=/x"))
    assert meta == stored(config(*overrides, "meshes=/yours", "renderer.threads=2"))
    assert meta == stored(config(*overrides, "meshes=/mine", "engine=slurm"))
    whole = OmegaConf.to_container(config(*overrides))
    unkept = {"paths", "workers", "engine", "force", "strict", "renderer", "meshes"}
    kept = set(whole) - unkept
    for key in kept:
        assert meta[key] == whole[key], key
    assert meta["renderer"] == {k: v for k, v in whole["renderer"].items() if k != "threads"}
    assert not re.search("/mine|/x", str(meta))


def test_scans_that_would_share_a_name_are_refused(tmp_path):
    folder = tmp_path / "chair" / "train"
    folder.mkdir(parents=True)
    for name in ("a", "a~1"):
        (folder / f"{name}.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    words = ("domain=modelnet10", f"meshes={tmp_path}", "classes=[chair]")
    assert len(mesh_items(config(*words))) == 2
    with pytest.raises(ConfigError, match="a~1"):
        mesh_items(config(*words, "scans=2"))


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["classes=[chair,dragon]"], "dragon"),
        (["fraction=0"], "fraction"),
        (["domain=specklenet10", "views=0"], "count"),
        (["domain=modelnet10", "+sensor=kinect_v1"], "no use"),
        (["domain=modelnet10", "keep_views=true"], "no use"),
        *(
            (["domain=blensor10", word], "no use")
            for word in ("materials=principled", "light=area")
        ),
        (["domain=kinectsim10", "poses=a.tar.gz"], "no use for poses"),
        (["domain=rooms10", "provenance=true"], "no use for provenance"),
        (["domain=modelnet10_dropout", "recipe.dropout.max_share=0.9"], "dropout"),
        (["materials=principled", "materials.albedo=1.2"], "albedo"),
    ],
)
def test_wrong_settings_name_their_key(words, key):
    with pytest.raises(ConfigError, match=key):
        planned(config(*words))
