"""clouds.png and infrared.png: drawn from what was scanned, also after a resume."""

import numpy as np
from PIL import Image

from qs3.generation.command import generate
from qs3.store.store import open_pointset
from tests.generation.generating import config


def picture(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(float)


def test_a_finished_dataset_has_its_pictures_and_config(finished, meshes):
    folder, pointset = finished
    for name in ("clouds.png", "infrared.png"):
        assert picture(folder / name).std() > 10
    assert f"data_dir: {folder.parent}" in (folder / "config.yaml").read_text()
    assert pointset.meta["config"]["classes"] == ["chair", "table", "lamp"]
    assert pointset.meta["config"]["test_fraction"] == 0.2
    assert str(folder.parent) not in (folder / "meta.yaml").read_text()


def test_force_takes_old_pictures_and_views_away(meshes, tmp_path):
    folder = tmp_path / "modelnet10"
    generate(config(tmp_path, meshes, "workers=0", domain="modelnet10"))
    assert not (folder / "infrared.png").exists()
    (folder / "infrared.png").write_bytes(b"old")
    (folder / "views" / "chair").mkdir(parents=True)
    (folder / "mine.txt").write_text("kept")
    generate(config(tmp_path, meshes, "workers=0", "force=true", domain="modelnet10"))
    assert {path.name for path in folder.iterdir()} == {
        ".lock", "clouds.png", "config.yaml", "manifest.csv", "meta.yaml", "mine.txt", "points.npy",
        "recipe.json",
    }  # fmt: skip
    assert len(open_pointset(folder)) == 9
