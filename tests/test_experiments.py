"""Every experiment file really runs: two batches an epoch, on files in the published formats."""

import functools
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from qs3.config.hydra import build, run_folder
from qs3.runs.metrics import read_metrics
from qs3.training.command import train
from tests.composing import compose
from tests.fixtures.published import write_domain

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A data folder into which the domains that are asked for are written, each once."""
    folder = tmp_path_factory.mktemp("published")
    write = functools.cache(lambda name: write_domain(name, folder))
    return SimpleNamespace(folder=folder, write=write)


FAST = ("own_meshes", "qs3_s2d")


@pytest.mark.parametrize(
    "experiment",
    [pytest.param(name, marks=[] if name in FAST else pytest.mark.slow) for name in EXPERIMENTS],
)
def test_experiment_runs(experiment, published, tmp_path):
    lines = (ROOT / "conf" / "experiment" / f"{experiment}.yaml").read_text().splitlines()
    assert lines[1].startswith(f"# python train.py experiment={experiment} ")
    overrides = [
        f"experiment={experiment}", "debug=fast", "data.points=64", "protocol.batch_size=8",
        "logger=csv", "seed=0", "trainer.threads=1",
        f"paths.data_dir={published.folder}", f"paths.log_dir={tmp_path}",
    ]  # fmt: skip
    if experiment in ("own_meshes", "own_scans"):
        overrides += ["data.target.floor_m=0"]
    cfg = compose("train", overrides)
    for domain in (cfg.data.source, cfg.data.target):
        if domain.name == "source_sample":  # it comes with qs3
            continue
        if Path(domain.path).exists():
            continue
        published.write(re.sub("_(kinect|synthetic)$", "", domain.name))  # parts of GraspNetPC-10
        store, own = published.folder / domain.name, Path(domain.path)
        if store.exists() and not own.exists():  # some experiments have a place of their own
            shutil.copytree(store, own)
    rounds = build(cfg.selftraining).rounds  # without self-training they may be set in vain
    if rounds:
        cfg.selftraining.rounds = 2
    metrics = train(cfg)
    assert metrics.experiment == experiment
    assert metrics == read_metrics(run_folder(cfg))
    assert len(metrics.rounds) == min(rounds, 2)
    if experiment in ("own_scans", "own_meshes"):  # folders are no labels: all clouds are theirs
        assert (metrics.final.n, metrics.final.accuracy) == (60, None)
    else:
        assert metrics.final.n == 20  # two test clouds of each of ten classes
    rooms = experiment.startswith("pretrained_")  # whose target is a source elsewhere
    assert metrics.simulated == (metrics.target.startswith("kinectsim10") or rooms)
