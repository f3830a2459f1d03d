"""Runs as training leaves them, for the tests of the report."""

import json


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
