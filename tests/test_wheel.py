"""A wheel, installed beside the dependencies that are there, works in a folder that is empty."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FEW = "catalogue.train=2 catalogue.test=1 workers=0"
TABLE = """title: mine
metrics: [accuracy]
columns: [target test]
rows:
- name: source only
  target test:
    run: {run}
"""


def call(*words: str | Path, cwd: Path, **more: str) -> str:
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, env={**os.environ, "OMP_NUM_THREADS": "1", **more},
        capture_output=True, text=True, check=False, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, f"{words}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder that it was installed into: QS3_WHEEL, or one that is built from a copy here."""
    copy, target = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-input"]
    alone = ["--no-index", "--no-deps"]
    if given := os.environ.get("QS3_WHEEL"):
        call(*pip, "install", *alone, "--target", target, given, cwd=copy)
        return target
    for name in ("qs3", "conf"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    call(*pip, "wheel", *alone, "--no-build-isolation", "-w", copy / "dist", copy, cwd=copy)
    (wheel,) = (copy / "dist").glob("qs3-*.whl")
    call(*pip, "install", *alone, "--target", target, wheel, cwd=copy)
    shutil.rmtree(copy)
    return target


@pytest.mark.slow
def test_everything_works_in_an_empty_folder(installed, tmp_path):
    def qs3(command: str, *words: str) -> str:
        return call(installed / "bin" / command, *words, cwd=tmp_path, PYTHONPATH=str(installed))

    where = "import qs3, qs3.config.location as at; print(qs3.__file__, at.CONF)"
    found = call(sys.executable, "-c", where, cwd=tmp_path, PYTHONPATH=str(installed)).split()
    assert found == [str(installed / "qs3" / "__init__.py"), str(installed / "qs3" / "conf")]
    assert "qs3-train experiment=quickstart" in qs3("qs3-train", "--help")
    assert "qs3-generate domain=specklenet10" in qs3("qs3-generate", "--help")
    assert "predict" in qs3("qs3", "--help")
    assert "table=NAME" in qs3("qs3", "report", "table", "--help")

    qs3("qs3-generate", "domain=modelnet10", *FEW.split())
    make = f"python generate.py domain=modelnet10 domain.path=source {FEW}"
    run = [
        "experiment=quickstart", "experiment_name=mine", "debug=fast", "logger=csv",
        "domain@data.source=modelnet10", "data.source.path=source", "data.make_source=true",
        f"data.source.make='{make}'", "domain@data.target=modelnet10", "selftraining=none",
        "model=pointnet", "data.points=64", "trainer.threads=1",
    ]  # fmt: skip
    said = qs3("qs3-train", *run)
    assert f"is made: qs3-generate {make.split(maxsplit=2)[2]}" in said
    (folder,) = (tmp_path / "logs" / "mine").iterdir()
    assert (folder / "train.log").is_file()
    qs3("qs3", "report", "page", f"run={folder}")
    assert (folder / "pictures" / "index.html").is_file()

    cell = " ".join(word for word in run if "make" not in word)  # it is made now
    (tmp_path / "mine.yaml").write_text(TABLE.format(run=cell))
    assert "1 runs to do" in qs3("qs3", "report", "train", "table=mine.yaml", "seeds=0,1")
    assert "source only" in qs3("qs3", "report", "table=mine.yaml")
    qs3("qs3", "predict", f"ckpt={folder}", "input=data/modelnet10/points.npy", "threads=1")
    assert len((tmp_path / "predictions.csv").read_text().splitlines()) == 31
    said = qs3("qs3", "predict", "input=data/modelnet10/points.npy", "threads=1")  # its own nets
    assert "classifier: dgcnn-speckle, which comes with qs3" in said
    assert "accuracy on real objects: right about " in said
