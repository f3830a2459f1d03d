"""Runs as training leaves them, for the tests of the report."""

import csv
import json

import matplotlib.image


def metrics(seed=0, accuracy=0.5, **changes):
    return {
        "experiment": "exp",
        "hash": "0123abcd",
        "seed": seed,
        "status": "finished",
        "source": "specklenet10",
        "target": "kinectsim10",
        "method": "pcm",
        "selftraining": "qbst",
        "model": "dgcnn",
        "simulated": True,
        "selection": {"teacher": f"source_val, epoch {3 + seed}", "student": "last"},
        "final": {
            "accuracy": accuracy,
            "balanced_accuracy": accuracy - 0.1,
            "majority_rate": 0.45,
            "n": 200,
        },
        "warmup": {},
        "rounds": [],
        "data": {"source": "a" * 64, "target": "b" * 64},
        "times": {},
        "versions": {},
        **changes,
    }


def write_run(log_dir, **changes):
    content = metrics(**changes)
    name = f"seed{content['seed']}-{content['hash']}"
    folder = log_dir / content["experiment"] / name
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(content))
    return folder


def table(path):
    """Rows of a CSV file."""
    return list(csv.DictReader(path.read_text().splitlines()))


def change(folder, **changes):
    """Put other values into a run's metrics.json."""
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics.update(changes)
    path.write_text(json.dumps(metrics))


def not_blank(path):
    """Whether a PNG has a size, and is neither white nor black."""
    image = matplotlib.image.imread(path)[..., :3]
    return image.shape[0] > 200 and 0.005 < (image.min(axis=2) < 0.9).mean() < 0.8
