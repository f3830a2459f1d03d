"""Features of both domains on a plane, of the warm-up's net and of the reported one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.datamodules.splits import load_clouds
from qs3.errors import Qs3Error
from qs3.evaluation.metrics import global_features
from qs3.inference.model_file import PACKAGES, build_net, read_result
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.runs import figures as run_figures
from qs3.report.runs.data import RunFiles
from qs3.report.runs.domains import open_domain
from qs3.report.runs.tsne import tsne
from qs3.runs.checkpoints import load
from qs3.store.store import PointSet
from qs3.utils.seeding import derive

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOUDS = 600
"""At most, of each domain."""

_WARMUP = "warmup_selected.pt"  # of qs3.selftraining.callback, which imports Lightning
_BATCH = 32


def draw_embedding(
    run: RunFiles,
    data_dir: str | Path | None = None,
    clouds: int = CLOUDS,
    packages: Sequence[str] = PACKAGES,
) -> Figure:
    """t-SNE of the global features of test clouds of source and target, before and after.

    "Before" are the weights that the warm-up selected, "after" those of the result: without rounds
    they are the same, and there is one panel. Which `clouds` follows from the run's seed.
    `packages` as of `qs3.load`.

    Raises:
        NothingToDrawError: data or weights are not there; says which.
        DataError: a dataset is damaged.
    """
    sets = [open_domain(run, role, data_dir) for role in ("source", "target")]
    assert run.metrics is not None
    try:
        result = read_result(run.folder)
        nets = {"result": build_net(result, packages)}
        if run.rounds and (run.folder / _WARMUP).is_file():
            before = load(run.folder / _WARMUP)
            first = build_net(dataclasses.replace(result, weights=before), packages)
            nets = {"after the warm-up": first, "after self-training": nets["result"]}
    except Qs3Error as error:
        raise NothingToDrawError(str(error)) from error
    if not all(callable(getattr(net, "features", None)) for net in nets.values()):
        raise NothingToDrawError("the net says nothing about its features")
    parts, labels, names = [], [], []
    for role, data in zip(("source", "target"), sets, strict=True):
        split = "test" if "test" in data.counts() else "train"
        points = load_clouds(data, split, result.points, scale=result.scale).points
        chosen = sample(len(points), clouds, derive(run.metrics.seed, "embedding", role))
        parts.append(points[chosen])
        labels.append(_labels(data, split)[chosen])
        names.append(f"{role}: {data.name}, {split}" + ("" if split == "test" else " split"))
    domain = np.repeat([0, 1], [len(part) for part in parts])
    places = {}
    for title, net in nets.items():
        features = [
            global_features(net, part, _BATCH, domain=role)
            for role, part in zip(("source", "target"), parts, strict=True)
        ]
        places[title] = tsne(np.concatenate(features))
    return run_figures.embedding(
        f"{run.title}, on {run.target}: features of clouds (t-SNE)\n"
        f"{meaning(np.concatenate(labels), domain)}",
        places,
        np.concatenate(labels),
        domain,
        run.classes,
        names,
    )


def meaning(labels: np.ndarray, domain: np.ndarray) -> str:
    """What the colours are: [n] labels with -1 unknown, [n] domain 0 source and 1 target."""
    if (labels[domain == 1] >= 0).any():
        return "colours are true classes, evaluation only"
    return "colours are the source's classes; those of the target are not known"


def sample(n: int, most: int, seed: int) -> np.ndarray:
    """[min(n, most)] different positions below n, ascending; all of them if there are few."""
    return np.sort(np.random.default_rng(seed).permutation(n)[:most])


def _labels(data: PointSet, split: str) -> np.ndarray:
    return np.array(data.labels[data.indices(split)])
