"""Runs as training leaves them, for the tests of the report."""

import csv
from dataclasses import replace

import matplotlib.image

from qs3.runs.metrics import (
    DataHashes,
    DataMadeOf,
    EpochScores,
    Evaluated,
    Loading,
    Quality,
    RunMetrics,
    Scores,
    Selection,
    Times,
    Warmup,
    read_metrics,
    write_metrics,
)
from qs3.store.meta import MadeOf

PUBLISHED = MadeOf(objects="published files", published=True)
CATALOGUE = MadeOf(objects="embedded catalogue", sensor="kinect_like", views=4, meshes="c" * 12)


def scores(accuracy=0.5, **changes):
    """Scores of 200 clouds of two classes; with accuracy=None of clouds without labels."""
    known = {}
    if accuracy is not None:
        known = {"accuracy": accuracy, "balanced_accuracy": accuracy - 0.1, "majority_rate": 0.45}
    return Scores(**{"n": 200, "predicted": {"a": 90, "b": 110}, **known, **changes})


def metrics(seed=0, accuracy=0.5, **changes):
    """A complete result; `changes` are its fields."""
    epoch = 3 + seed
    before = EpochScores(epoch=epoch, scores=scores())
    content = {
        "experiment": "exp",
        "hash": "0123abcd",
        "config_sha256": "0123abcd" * 8,
        "source": "specklenet10",
        "target": "kinectsim10",
        "method": "pcm",
        "selftraining": "qbst",
        "model": "dgcnn",
        "simulated": True,
        "selection": Selection(teacher=f"source_val, epoch {epoch}", student="last"),
        "loading": Loading(points=1024, scale="unit_ball", fps_starts=4, sampler="shuffled"),
        "final": scores(accuracy),
        "evaluation": Evaluated(split="test", labels=accuracy is not None, norms="trained"),
        "warmup": Warmup(selected=before, last=before),
        "infomax": 0.5,
        "quality": Quality(
            validation_accuracy=0.9,
            unlike_source=0.1,
            never_predicted=[],
        ),
        "data": DataHashes(source="a" * 64, target="b" * 64),
        "times": Times(seconds=60.0, core_seconds=90.0, memory_gb=0.5, gpu_memory_gb=2.0),
        "versions": {"qs3": "0.1.0"},
    }
    content |= changes
    target = CATALOGUE if content["simulated"] else PUBLISHED
    content.setdefault("made_of", DataMadeOf(source=PUBLISHED, target=target))
    return RunMetrics(seed=seed, **content)


def write_run(log_dir, **changes):
    content = metrics(**changes)
    folder = log_dir / content.experiment / f"seed{content.seed}-{content.hash}"
    folder.mkdir(parents=True)
    write_metrics(folder, content)
    return folder


def table(path):
    """Rows of a CSV file."""
    return list(csv.DictReader(path.read_text().splitlines()))


def change(folder, **changes):
    """Put other values into a run's metrics.json."""
    write_metrics(folder, replace(read_metrics(folder), **changes))


def not_blank(path):
    """Whether a PNG has a size, and is neither white nor black."""
    image = matplotlib.image.imread(path)[..., :3]
    return image.shape[0] > 200 and 0.005 < (image.min(axis=2) < 0.9).mean() < 0.8
