"""SpeckleNet40: the forty classes of ModelNet40 from a folder of meshes."""

import pytest

from qs3.classes import CLASSES, MODELNET40, class_list, known_as
from qs3.errors import ConfigError
from qs3.generation.command import generate
from qs3.generation.objects import mesh_items
from qs3.store.store import open_pointset
from tests.fixtures.modelnet import write_off_tree
from tests.generation.generating import config


def test_names():
    assert len(MODELNET40) == len(set(MODELNET40)) == 40
    assert list(MODELNET40) == sorted(MODELNET40)
    assert set(CLASSES) - set(MODELNET40) == {"cabinet"}
    assert known_as("Night-Stand", MODELNET40) == "night_stand"
    assert known_as("night stand", CLASSES) == "cabinet"
    assert known_as("airplane", CLASSES) is None
    assert known_as("Tra\u0308ger", ("Tr\u00e4ger",)) == "Tr\u00e4ger"  # as macOS writes it
    assert class_list(None) == CLASSES
    assert class_list("modelnet40") == MODELNET40
    assert class_list(["b", "a"]) == ("b", "a")


def test_generated_from_meshes(tmp_path):
    write_off_tree(tmp_path / "meshes", {"train": 1, "test": 1}, MODELNET40)
    cfg = config(tmp_path / "data", tmp_path / "meshes", "workers=1", domain="specklenet40")
    cfg.classes = ["airplane", "night_stand", "xbox"]
    generate(cfg)
    data = open_pointset(tmp_path / "data" / "specklenet40")
    assert data.classes == MODELNET40
    assert data.ids == tuple(
        f"{c}/{s}/{c}_000{i}"
        for c in ("airplane", "night_stand", "xbox")
        for i, s in enumerate(("train", "test"), start=1)
    )
    assert data.labels.tolist() == [MODELNET40.index(name.split("/")[0]) for name in data.ids]


def test_the_embedded_catalogue_has_ten_classes(tmp_path):
    cfg = config(tmp_path, domain="specklenet40")
    cfg.classes = None
    with pytest.raises(ConfigError, match=r"embedded catalogue has no airplane, .*meshes=PATH"):
        mesh_items(cfg)
    cfg.classes = ["cup", "cabinet"]
    with pytest.raises(ConfigError, match=r"\['cabinet'\] are not among"):
        generate(cfg)
