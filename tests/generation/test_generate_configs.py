"""Every domain that can be generated composes, instantiates, and says what it needs."""

import contextlib
import re
import subprocess
import sys
from collections import Counter

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from qs3.classes import CLASSES
from qs3.config.hydra import build
from qs3.config.location import CONF
from qs3.errors import ConfigError, MissingDataError
from qs3.generation.camera_poses import AnchoredViews
from qs3.generation.checks import KEYS, check
from qs3.generation.objects import mesh_items
from qs3.generation.plan import benchmark, describe, settings, stored_config
from qs3.generation.scenes import Alone, Room
from qs3.tools import quickstart
from tests.generation.generating import ROOT
from tests.generation.generating import composed as config

DOMAINS = (
    *("specklenet10", "specklenet10_clean", "blensor10", "kinectsim10"),
    *("modelnet10", "modelnet10_dropout"),
    *("specklenet10_view", "specklenet10_kinect", "roomscan10", "kinectsim10_full"),
)


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
    assert recipe.views == AnchoredViews(5, 3, 5, 20, 50, 0.1, 0.1)


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


def plan(*overrides, domain="kinectsim10"):
    cfg = config(f"domain={domain}", *overrides)
    return benchmark(cfg, describe(cfg, mesh_items(cfg), {}))


def test_the_benchmark_knows_itself():
    """A change of any setting is another version: give it a new number and a new hash."""
    assert plan() == "kinectsim10 v2"
    assert plan("renderer.threads=2", "renderer.variant=scalar_rgb", "workers=1") == plan()
    for other in ("fraction=0.5", "views=3", "renderer.samples=4", "recipe.min_points=100"):
        assert plan(other).startswith("like kinectsim10 v2, but not it")


def test_a_part_of_the_benchmark_is_called_so():
    """Its objects are those of the whole, byte for byte: each has a seed of its own."""
    assert plan("splits=[train]") == "kinectsim10 v2, train"
    assert plan("splits=[test]", "workers=1") == "kinectsim10 v2, test"
    assert plan("splits=[train]", domain="roomscan10") == "roomscan10 v4, train"
    for other in ("fraction=0.5", "views=3", "classes=[chair,table]"):
        assert plan("splits=[train]", other).startswith("like kinectsim10 v2, but not it")
    cfg = config("domain=kinectsim10", "splits=[train]")
    fewer = mesh_items(cfg)[1:]  # such as what the config does not say
    assert benchmark(cfg, describe(cfg, fewer, {})).startswith("like kinectsim10 v2, but not it")


def test_so_does_the_one_in_scannet10s_sizes():
    assert plan(domain="kinectsim10_full") == "kinectsim10_full v1"
    assert plan("limit=3", domain="kinectsim10_full").startswith("like kinectsim10_full v1, but")
    items = mesh_items(config("domain=kinectsim10_full"))
    assert Counter(item.split for item in items) == {"train": 6110, "test": 1769}
    # PointDA's ScanNet-10, class by class; kinectsim10 is a part of it.
    smaller = mesh_items(config("domain=kinectsim10"))
    assert {item.id for item in smaller} <= {item.id for item in items}
    by_id = {item.id: item.origin for item in items}
    assert all(by_id[item.id] == item.origin for item in smaller)


def test_a_source_can_have_the_sizes_of_the_published_one():
    """4,183 and 856 objects: PointDA's ModelNet-10, from whose meshes the paper's S was scanned."""
    items = mesh_items(config("domain=specklenet10", "counts=modelnet10"))
    assert Counter(item.split for item in items) == {"train": 4183, "test": 856}
    assert sum(item.cls == "lamp" for item in items) == 124 + 20


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


def test_halves_that_are_filled_up_share_no_object_of_the_catalogue(tmp_path):
    own = own_meshes(tmp_path, chair=4, lamp=1)
    (tmp_path / "table" / "train").mkdir(parents=True)  # empty: as if it were not there
    words = ("domain=modelnet10", own, "fill_up=true", "up=z", "limit=3", "splits=[train]")

    def made(half):
        items = mesh_items(config(*words, f"half={half}"))
        assert Counter(item.cls for item in items) == dict.fromkeys(CLASSES, 3)
        return {item.load().sha256 for item in items if item.path is None}

    first, second = made("first"), made("second")
    assert len(first) == 30 - 3
    assert not first & second
    plans = [settings(config(*words, f"half={half}"))["meshes"] for half in ("first", "second")]
    assert plans[0] != plans[1]


def test_filled_up_is_another_plan_and_unfilled_the_same_as_ever(tmp_path):
    own = own_meshes(tmp_path, **dict.fromkeys(CLASSES, 1))
    alone = settings(config("domain=modelnet10", own, "up=z"))
    assert alone["meshes"] == "folder"
    filled = settings(config("domain=modelnet10", own, "up=z", "fill_up=true"))
    assert filled["meshes"]["folder, filled up by"]["train"] == 100
    more = settings(config("domain=modelnet10", own, "up=z", "fill_up=true", "catalogue.train=5"))
    assert more != filled


def test_filling_up_needs_meshes_and_says_what_it_cannot_fill(tmp_path):
    with pytest.raises(ConfigError, match="give them with meshes=PATH"):
        check(config("domain=modelnet10", "fill_up=true"))
    with pytest.raises(MissingDataError, match="no folder of"):  # nothing of ours at all
        mesh_items(config("domain=modelnet10", f"meshes={tmp_path}", "fill_up=true"))
    own = own_meshes(tmp_path, chair=1)
    with pytest.raises(MissingDataError, match=r"no folder of .*table"):
        mesh_items(config("domain=modelnet10", own))
    with pytest.raises(MissingDataError, match=r"no folder of .*airplane"):
        mesh_items(config("domain=specklenet40", own, "fill_up=true"))
    (tmp_path / "chair" / "train" / "catalogue-chair_0003.off").touch()
    with pytest.raises(ConfigError, match="rename the file"):
        mesh_items(config("domain=modelnet10", own, "fill_up=true"))


def test_so_does_the_source_of_room_scans():
    """Likewise: results name the version that they were measured with."""
    assert plan(domain="roomscan10") == "roomscan10 v4"
    for other in ("recipe.torn=0.4", "limit=3", "scans=2"):
        assert plan(other, domain="roomscan10").startswith("like roomscan10 v4, but not it")


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
    for row in OmegaConf.load(CONF / "table" / "quickstart.yaml").rows:
        cfg = config(*row["target test"]["run"].split(), name="train")
        assert cfg.experiment_name == "quickstart"


@pytest.fixture(scope="module")
def help_text():
    command = [sys.executable, "generate.py", "--help"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_help_is_short(help_text):
    for key in (
        "domain=specklenet10", "meshes=PATH", "provenance=true", "keep_views=true", "poses=FILE",
        "limit=", "classes=", "views=N", "workers=N", "force=true", "strict=true",
        "paths.data_dir=",
    ):  # fmt: skip
        assert key in help_text
    assert len(help_text.splitlines()) < 75
    assert max(map(len, help_text.splitlines())) <= 110


GROUPS = (
    *("sensor", "sensor/matcher", "synthesis", "scene", "materials", "light", "tracking", "crop"),
    *("renderer", "released", "counts", "engine"),
)


def names(group):
    files = {path.stem for path in (ROOT / "conf" / group).glob("*.yaml")}
    if group == "synthesis":  # parts of others have no domain of their own
        files &= {path.stem for path in (ROOT / "conf" / "domain").glob("*.yaml")}
    return sorted(files - {"none"})


def test_help_says_what_conf_has(help_text):
    for name in (name for group in GROUPS for name in names(group)):
        assert re.search(rf"(^|[ |]){name}( |$)", help_text, re.MULTILINE), name
    (line,) = [x for x in help_text.splitlines() if x.startswith("  kinect_like ")]
    first = (ROOT / "conf/sensor/kinect_like.yaml").read_text().splitlines()[0]
    assert line.split(maxsplit=1)[1] == first.removeprefix("# ").removesuffix(".")
    examples = [x.split() for x in help_text.splitlines() if x.startswith("  python generate.py")]
    assert len(examples) >= 6
    for words in examples:
        config(*(word for word in words[2:] if "=" in word))


@pytest.mark.parametrize("domain", ["specklenet10", "kinectsim10"])
def test_scene_tracking_and_crop_go_with_every_domain_that_looks(domain):
    groups = ("scene", "tracking", "crop")
    lists = [names(group) for group in groups]
    for i in range(max(map(len, lists))):
        chosen = [(group, some[i % len(some)]) for group, some in zip(groups, lists, strict=True)]
        cfg = config(f"domain={domain}", *(f"{group}={name}" for group, name in chosen))
        check(cfg)
        recipe, choice = build(cfg.recipe), dict(chosen)
        kinds = {"alone": Alone, "room": Room, "furnished": Room}
        assert type(recipe.scene) is kinds[choice["scene"]]
        assert (recipe.drift.shift_m > 0) == (choice["tracking"] == "drifting")
        assert type(recipe.crop).__name__.lower() == f"{choice['crop']}crop"
    recipe = build(config(f"domain={domain}", "scene=room", "scene.max_clutter=0").recipe)
    assert recipe.scene.max_clutter == 0


def test_meta_holds_the_whole_config_but_places_and_what_changes_no_byte():
    overrides = ("limit=3", "scene=room", "renderer=mitsuba")
    stored = stored_config(config(*overrides, "meshes=/mine", "workers=3", "paths.data_dir=/x"))
    assert stored == stored_config(config(*overrides, "meshes=/yours", "renderer.threads=2"))
    assert stored == stored_config(config(*overrides, "meshes=/mine", "engine=slurm"))
    whole = OmegaConf.to_container(config(*overrides))
    unkept = {"paths", "workers", "engine", "force", "strict", "renderer", "meshes"}
    kept = set(whole) - unkept
    for key in kept:
        assert stored[key] == whole[key], key
    assert stored["renderer"] == {k: v for k, v in whole["renderer"].items() if k != "threads"}
    assert not re.search("/mine|/x", str(stored))


@pytest.mark.parametrize("key", ["provenance", "keep_views", "force", "strict"])
def test_switches_are_true_or_false(key):
    with pytest.raises(ConfigError, match=f"{key} must be true or false, got 'maybe'"):
        check(config(f"{key}=maybe"))


@pytest.mark.parametrize(
    ("domain", "words", "message"),
    [
        ("modelnet10", "recipe.points=0", r"recipe\.points must be >= 1, got 0"),
        ("specklenet10", "recipe.min_points=oops", r"recipe\.min_points must be >= 0, got 'oops'"),
        (
            "modelnet10_dropout",
            "recipe.dropout.max_share=0.4",
            r"max_regions=3 times recipe\.dropout\.max_share=0\.4 is 120% of a cloud: .* 80%",
        ),
        ("modelnet10_dropout", "recipe.dropout.min_regions=5", r"min_regions=5 is above .*=3"),
        ("specklenet10", "recipe.views.min_elevation_deg=60", "min_elevation_deg=60 is above"),
        ("kinectsim10", "recipe.placing.fallback_side_m=-1", "fallback_side_m must be > 0"),
        ("kinectsim10", "crop.min_grow_px=5", r"crop\.min_grow_px=5 is above crop\.max_grow_px=3"),
        ("kinectsim10", "recipe.views.max_arc_deg=10", "min_arc_deg=30.0 is above"),
        ("kinectsim10", "tracking.shift_m=-1", r"tracking\.shift_m must be >= 0, got -1"),
        ("kinectsim10", "scene.max_clutter=-2", r"scene\.max_clutter must be a whole number >= 0"),
        ("kinectsim10", "scene.min_albedo=0.95", r"scene\.min_albedo=0\.95 is above"),
    ],
)
def test_ranges_are_checked_before_anything_is_made(domain, words, message):
    with pytest.raises(ConfigError, match=message):
        build(config(f"domain={domain}", words).recipe)


@pytest.mark.parametrize(("words", "key"), [("classes=[]", "classes"), ("meshes=", "meshes")])
def test_nothing_is_not_everything(words, key):
    with pytest.raises(ConfigError, match=f"^{key}="):
        check(config("domain=modelnet10", words))


def test_a_key_that_was_added_and_that_nothing_reads_is_refused():
    """Hydra advises + for any key it does not know; +limt=1 would scan everything."""
    with pytest.raises(ConfigError, match="limt is no setting, nothing reads it; did you mean lim"):
        check(config("domain=modelnet10", "+limt=1"))
    check(config("domain=modelnet10", "+few=3", "limit=${few}"))


@pytest.mark.parametrize("file", sorted((CONF / "synthesis").glob("*.yaml")), ids=lambda f: f.stem)
def test_every_key_of_conf_is_known(file):
    for more in ((), ("materials=mixed", "light=area"), ("released=yes",), ("engine=ray",)):
        with contextlib.suppress(HydraException):  # not every domain has a light
            assert set(config(f"synthesis={file.stem}", *more)) <= set(KEYS)


def test_a_class_that_was_misspelt_is_told_which_is_meant():
    with pytest.raises(ConfigError, match=r"\['chairs'\] are not .*; did you mean chair\?$"):
        check(config("domain=modelnet10", "classes=[chairs,table]"))


def test_who_names_other_classes_learns_how_to_give_them():
    words = ("domain=modelnet10", "classes=[bracket]")
    with pytest.raises(ConfigError, match=r"\['bracket'\] are not .*'\+domain.classes=\[\.\.\.\]'"):
        check(config(*words))
    check(config(*words, "+domain.classes=[bracket]", "domain.path=data/parts"))


def test_scans_that_would_share_a_name_are_refused(tmp_path):
    folder = tmp_path / "chair" / "train"
    folder.mkdir(parents=True)
    for name in ("a", "a~1"):
        (folder / f"{name}.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    words = ("domain=modelnet10", f"meshes={tmp_path}", "classes=[chair]")
    assert len(mesh_items(config(*words))) == 2
    with pytest.raises(ConfigError, match=r"a~1\.off: with scans=2 another mesh's scan is called"):
        mesh_items(config(*words, "scans=2"))
