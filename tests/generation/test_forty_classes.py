"""SpeckleNet40: the forty classes of ModelNet40 from a folder of meshes."""

from qs3.classes import MODELNET40
from qs3.generation.command import generate
from qs3.store.store import open_pointset
from tests.fixtures.modelnet import write_off_tree
from tests.generation.generating import config


def test_generated_from_meshes(tmp_path):
    write_off_tree(tmp_path / "meshes", {"train": 1, "test": 1}, MODELNET40)
    cfg = config(tmp_path / "data", tmp_path / "meshes", "workers=1", "+domain.classes=modelnet40")
    cfg.classes = ["airplane", "night_stand", "xbox"]
    generate(cfg)
    data = open_pointset(tmp_path / "data" / "specklenet10")
    assert data.classes == MODELNET40
    assert data.ids == tuple(
        f"{c}/{s}/{c}_000{i}"
        for c in ("airplane", "night_stand", "xbox")
        for i, s in enumerate(("train", "test"), start=1)
    )
    assert data.labels.tolist() == [MODELNET40.index(name.split("/")[0]) for name in data.ids]
