"""Results of runs as a data frame: one line a run, read from log folders or from a kept file.

A kept file (`qs3 report keep`, docs/results/*.csv.gz) is such a frame as compressed CSV. Its lines
are named by the table's row, column and seed, and hold what the net called each test cloud, so that
all figures and paired intervals of the table can be printed without the runs. Columns:

    row, column, seed         place in the table
    experiment, hash, command how the run was made
    source, target, ...       names, hashes and makings of both datasets
    accuracy, ...             `SCORES`, in [0, 1]
    clouds                    hash of the test clouds' ids
    labels, called            class number of each test cloud: true (-1: not known), and predicted
    clusters, clusters_are    number of what each test cloud shares with others, and what that is
    tiers                     "clean" or "hard" for each test cloud, where the dataset has tiers
"""

from __future__ import annotations

import gzip
import hashlib
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from qs3.catalogue import FAMILY
from qs3.datasets.object_archive import TIERS
from qs3.errors import DataError
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics
from qs3.runs.predictions import FILE, read_predictions
from qs3.utils.files import reading, write_bytes
from qs3.utils.text_table import aligned

FEW_SEEDS = 3
"""Below this number of seeds a mean is marked."""

_NAMES = ("accuracy", "balanced_accuracy", "majority_rate")
SCORES = (*_NAMES, *(f"{name}_{tier}" for tier in TIERS for name in _NAMES))
_COSTS = ("seconds", "core_seconds", "memory_gb", "gpu_memory_gb")
_SEEN = {
    "source_data": "the source dataset differs",
    "target_data": "the target dataset differs",
    "weights": "the classifier that they began with differs",
}
_FLAGS = ("simulated", "published", "diverged", "labelled")
_UNKNOWN: dict[str, Any] = {
    **dict.fromkeys(("problem", "folder", "take", "called"), ""),
    **dict.fromkeys(_FLAGS, False),
    **dict.fromkeys((*SCORES, *_COSTS), np.nan),
}
"""Columns that every frame has, and what stands there where nothing is known."""

NO_RUNS = pd.DataFrame([{"seed": 0, **dict.fromkeys(_SEEN, ""), **_UNKNOWN}])[:0]
"""A frame without lines."""

_FOLDER = re.compile(r"seed(\d+)-([0-9a-f]+)")
_BLOCK = re.compile(r"(?:\w+_)?block\d+")  # as importers of frames name them
MESHES, FAMILIES = "meshes", "families of meshes"
BLOCKS, ROOMS, CLOUDS = "blocks of frames", "rooms", "clouds"
"""What test clouds of one cluster share; of `CLOUDS` it is not known, each counts by itself."""


def record(metrics: RunMetrics, take: str) -> dict[str, Any]:
    """A line of the frame without its place and predictions; of take "warmup" the teacher's."""
    final, made_of, rules = take == "final", metrics.made_of, metrics.selection
    tiers = (metrics.evaluation.tiers or {}) if final else {}
    scores = {"": metrics.final if final else metrics.warmup.selected.scores}
    scores |= {f"_{tier}": tiers[tier] for tier in TIERS if tier in tiers}
    return {
        "seed": metrics.seed,
        "experiment": metrics.experiment,
        "hash": metrics.hash,
        "method": metrics.method,
        "selftraining": metrics.selftraining,
        "source": metrics.source,
        "target": metrics.target,
        "simulated": metrics.simulated,
        "source_made_of": str(made_of.source),
        "target_made_of": str(made_of.target),
        "data": "; ".join(f"{name}: {made}" for name, made in metrics.domains.items()),
        "published": all(made.published for made in metrics.domains.values()),
        "meshes": made_of.source.meshes * (metrics.source != metrics.target),
        "source_recipe": made_of.source.recipe,
        "target_recipe": made_of.target.recipe,
        **{key: metrics.seen[key.removesuffix("_data")] for key in _SEEN},
        "teacher_selected": rules.teacher.split(", epoch")[0],
        "student_selected": (rules.student if final else rules.teacher).split(", epoch")[0],
        "diverged": metrics.diverged,
        "labelled": scores[""].accuracy is not None,
        **{f"{n}{tier}": getattr(s, n) for tier, s in scores.items() for n in _NAMES},
        **{name: getattr(metrics.times, name) for name in _COSTS},
    }


def load_runs(log_dir: str | Path) -> dict[tuple[str, str, str], pd.DataFrame]:
    """All runs below a folder by experiment, hash and take; a `problem` if one is unfinished."""
    root = Path(log_dir)
    folders = {path.parent for path in root.rglob(METRICS)}
    folders |= {p for p in root.rglob("seed*-*") if p.is_dir() and _FOLDER.fullmatch(p.name)}
    found = defaultdict(list)
    for folder in sorted(folders):
        for line in load_run(folder):
            found[line["experiment"], line["hash"], line["take"]].append(line)
    return {key: pd.DataFrame(lines) for key, lines in found.items()}


def load_run(folder: Path) -> Iterator[dict[str, Any]]:
    """A run's line of either take."""
    match = _FOLDER.fullmatch(folder.name)
    seed, config = (int(match[1]), match[2]) if match else (-1, "")
    named = {"seed": seed, "experiment": folder.parent.name, "hash": config}
    metrics, problem = None, "unfinished"
    try:
        metrics = read_metrics(folder)
    except DataError as error:
        problem = str(error)
    for take in ("final", "warmup"):
        line = named | {"problem": problem} if metrics is None else record(metrics, take)
        yield line | _UNKNOWN | line | {"take": take, "folder": str(folder)}


def write_kept(path: Path, lines: pd.DataFrame) -> None:
    """Write a kept file, atomically; the same lines give the same bytes."""
    text = lines.to_csv(index=False, lineterminator="\n")
    write_bytes(path, gzip.compress(text.encode(), mtime=0))


def read_kept(path: str | Path, target: str | None = None) -> dict[tuple[str, str], pd.DataFrame]:
    """Read a kept file: the lines of each row and column; only those on a target if it is given."""
    numbers: dict[str, type] = {**dict.fromkeys((*SCORES, *_COSTS), float), "seed": int}
    with reading(path):
        lines = pd.read_csv(
            path,
            dtype=defaultdict[str, type](lambda: str, numbers),
            keep_default_na=False,
            na_values={name: [""] for name in numbers},
        )
        lines = lines.assign(**{name: of for name, of in _UNKNOWN.items() if name not in lines})
        lines = lines.assign(**{name: lines[name].astype(str) == "True" for name in _FLAGS})
        lines = lines if target is None else lines[lines.target == target]
        return dict(iter(lines.groupby(["row", "column"], sort=False)))


@dataclass(frozen=True, eq=False)
class Answers:
    """What a run called each test cloud: columns of the frame as arrays [n]."""

    labels: Int[np.ndarray, " n"]
    called: Int[np.ndarray, " n"]
    clusters: Int[np.ndarray, " n"]
    tiers: np.ndarray
    clouds: str
    clusters_are: str

    @property
    def as_text(self) -> dict[str, str]:
        """As columns of a kept file."""
        return {
            key: value if isinstance(value, str) else " ".join(map(str, value.tolist()))
            for key, value in vars(self).items()
        }


def answers_of(run: Mapping[str, Any]) -> Answers:
    """Answers of a line of the frame, or of the predictions in its folder."""
    if run.get("called"):
        labels, called, clusters = (
            np.array(run[key].split(), dtype=int) for key in ("labels", "called", "clusters")
        )
        tiers = np.array(run["tiers"].split())
        return Answers(labels, called, clusters, tiers, run["clouds"], run["clusters_are"])
    if not run["folder"]:
        raise DataError(f"no predictions of {run['experiment']}, seed {run['seed']}, are kept")
    found = read_predictions(Path(run["folder"]) / FILE)
    digest = hashlib.sha256("\n".join((*found.classes, "", *found.ids)).encode()).hexdigest()
    are = ROOMS if found.tiers else MESHES
    if all(_BLOCK.fullmatch(name) for name in found.meshes):
        are = BLOCKS
    elif all(name.startswith(FAMILY) for name in found.meshes):
        are = FAMILIES
    elif found.meshes == found.ids:
        are = CLOUDS
    clusters = np.unique(found.meshes, return_inverse=True)[1]
    tiers = np.array(found.tiers, dtype=str)
    return Answers(found.labels, found.predicted, clusters, tiers, digest[:16], are)


@dataclass(frozen=True)
class Stat:
    """Mean over n seeds with its standard error (None for one seed), in [0, 1]."""

    mean: float
    sem: float | None
    n: int

    @staticmethod
    def of(values: pd.Series) -> Stat:
        """From at least one value."""
        sem = float(values.sem()) if len(values) > 1 else None
        return Stat(float(values.mean()), sem, len(values))

    def percent(self) -> str:
        """Such as "64.0 ± 1.0"; of few seeds with their number, "64.0 (n=1)"."""
        sem = "" if self.sem is None else f" ± {100 * self.sem:.1f}"
        return f"{100 * self.mean:.1f}{sem}{f' (n={self.n})' * (self.n < FEW_SEEDS)}"


class Runs:
    """The runs of one config; those that saw different datasets have no mean.

    Datasets of one recipe, made by machines that round in other ways, are one dataset.
    """

    def __init__(self, lines: pd.DataFrame) -> None:
        self.lines = lines.sort_values("seed", kind="stable")
        self.finished = self.lines[self.lines.problem == ""]

    @property
    def seeds(self) -> list[int]:
        """Seeds of the finished runs."""
        return self.finished.seed.tolist()

    def stat(self, score: str) -> Stat | None:
        """Mean of one of `SCORES` over seeds; None if nothing may be averaged."""
        values = self.finished[score]
        return None if values.empty or values.isna().any() or self.apart else Stat.of(values)

    @property
    def problems(self) -> list[str]:
        """Unfinished or diverged seeds, and why seeds cannot be averaged."""
        failed = self.lines[self.lines.problem != ""]
        found = [f"seed {r.seed}: {r.problem} ({r.folder})" for r in failed.itertuples()]
        if diverged := _list(self.finished[self.finished.diverged].seed):
            found.append(f"seeds {diverged}: the net has diverged, one class for all: averaged")
        return [*found, *self.apart]

    @cached_property
    def apart(self) -> list[str]:
        """Why the finished seeds may not be averaged; [] if they may."""
        found = []
        if not (twice := self.finished[self.finished.seed.duplicated(keep=False)]).empty:
            places = ", ".join(twice.folder)
            found.append(f"seeds {_list(twice.seed.unique())} occur twice ({places}): not averaged")
        for key, what in _SEEN.items():
            if not same_data(self.finished, key):
                by_hash = self.finished.groupby(key, sort=False).seed
                versions = (f"seeds {_list(seeds)}: {sha[:12]}" for sha, seeds in by_hash)
                found.append(f"{what} ({'; '.join(versions)}): not averaged")
        return found


def same_data(lines: pd.DataFrame, key: str) -> bool:
    """Whether runs saw the same: equal hashes in a column, or datasets made by one recipe."""
    if lines.empty:
        return True
    recipes = lines.get(key.replace("_data", "_recipe"))
    one_recipe = key != "weights" and recipes is not None and recipes.nunique() == 1
    return lines[key].nunique() < 2 or bool(one_recipe and recipes.iloc[0])


def _list(seeds: pd.Series | np.ndarray) -> str:
    return ", ".join(map(str, seeds))


def data_lines(lines: pd.DataFrame) -> list[str]:
    """What the data of runs are made of: "data: specklenet10: embedded catalogue, ..."; once."""
    parts = [part for text in lines.get("data", ()) for part in text.split("; ") if part]
    return [f"data: {part}" for part in dict.fromkeys(parts)]


def summarise(folders: Sequence[Path], settings: Mapping[Path, str] | None = None) -> str:
    """A text table of the runs in `folders`, a line a config, with how it differs (`settings`)."""
    differing = [(settings or {}).get(folder, "") for folder in folders]
    lines = pd.DataFrame([next(load_run(folder)) for folder in folders]).assign(settings=differing)
    rows, notes = [], []
    for key, some in lines.groupby(["experiment", "hash"], sort=False):
        runs = Runs(some)
        row = {"experiment": key[0], "settings": some.settings.iloc[0] or "-"}
        if runs.seeds:
            first = runs.finished.iloc[0]
            mark = " (simulated target)" * bool(first.simulated)
            row["source -> target"] = f"{first.source} -> {first.target}{mark}"
            row |= {"method": first.method, "self-training": first.selftraining}
            if not first.labelled:
                notes.append(f"{' '.join(key)}: no target labels, so no accuracy")
        for words, name in zip(("accuracy", "balanced", "majority"), _NAMES, strict=True):
            if stat := runs.stat(name):
                row[words] = f"{100 * stat.mean:.1f}" if words == "majority" else stat.percent()
        row["seeds"] = str(len(runs.seeds))
        rows.append(row)
        notes += [f"{' '.join(key)}, {words}" for words in runs.problems]
    header = ["experiment", "settings", "source -> target", "method", "self-training"]
    header += ["accuracy", "balanced", "seeds", "majority"]
    table = [header, *([row.get(name, "-") for name in header] for row in rows)]
    notes += data_lines(lines[lines.problem == ""])
    caption = "Accuracy on the target's test split in %, mean ± SEM over seeds."
    return "\n".join([caption, *aligned(table), *notes])
