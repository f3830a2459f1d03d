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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from qs3.datasets.object_archive import TIERS
from qs3.errors import ConfigError, DataError
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics
from qs3.runs.predictions import FILE, read_predictions
from qs3.utils.files import write_bytes
from qs3.utils.text_table import aligned

FEW_SEEDS = 3
"""Below this number of seeds a mean is marked."""

_NAMES = ("accuracy", "balanced_accuracy", "majority_rate")
SCORES = (*_NAMES, *(f"{name}_{tier}" for tier in TIERS for name in _NAMES))
COSTS = ("seconds", "core_seconds", "memory_gb", "gpu_memory_gb")
_NUMBERS = (*SCORES, *COSTS)
_FLAGS = ("simulated", "published", "diverged", "labelled")
_FOLDER = re.compile(r"seed(\d+)-([0-9a-f]+)")
_BLOCK = re.compile(r"(?:\w+_)?block\d+")  # as importers of frames name them
_BEGUN = ("started.json", "last.ckpt", ".hydra")
_SEEN = {
    "source_data": "the source dataset differs",
    "target_data": "the target dataset differs",
    "weights": "the classifier that they began with differs",
}
MESHES, BLOCKS, ROOMS, CLOUDS = "meshes", "blocks of frames", "rooms", "clouds"
"""What test clouds of one cluster share; of `CLOUDS` it is not known, each counts by itself."""


def record(metrics: RunMetrics, take: str = "final") -> dict[str, Any]:
    """A line of the frame, without its place and predictions.

    Args:
        metrics: of a finished run.
        take: "final", or "warmup" for the scores of the teacher of round 0.
    """
    final = take == "final"
    tiers = (metrics.evaluation.tiers or {}) if final else {}
    scores = {"": metrics.final if final else metrics.warmup.selected.scores}
    scores |= {f"_{tier}": tiers[tier] for tier in TIERS if tier in tiers}
    rules = metrics.selection
    return {
        "seed": metrics.seed,
        "experiment": metrics.experiment,
        "hash": metrics.hash,
        "problem": "",
        "take": take,
        "method": metrics.method,
        "selftraining": metrics.selftraining,
        "source": metrics.source,
        "target": metrics.target,
        "simulated": metrics.simulated,
        "source_made_of": str(metrics.made_of.source),
        "target_made_of": str(metrics.made_of.target),
        "data": "; ".join(f"{name}: {made}" for name, made in metrics.domains.items()),
        "published": all(made.published for made in metrics.domains.values()),
        "meshes": metrics.made_of.source.meshes * (metrics.source != metrics.target),
        **{
            f"{role}_recipe": getattr(metrics.made_of, role).recipe for role in ("source", "target")
        },
        **{key: metrics.seen[key.removesuffix("_data")] for key in _SEEN},
        "teacher_selected": rules.teacher.split(", epoch")[0],
        "student_selected": (rules.student if final else rules.teacher).split(", epoch")[0],
        "diverged": metrics.diverged,
        "labelled": scores[""].accuracy is not None,
        **{f"{n}{tier}": getattr(s, n) for tier, s in scores.items() for n in _NAMES},
        **{name: getattr(metrics.times, name) for name in COSTS},
    }


def load_runs(log_dir: str | Path) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """All runs below a folder by experiment and hash, unfinished and damaged ones included.

    Each is what `load_run` returns.
    """
    root = Path(log_dir)
    folders = {path.parent for path in root.rglob(METRICS)}
    folders |= {p for p in root.rglob("seed*-*") if p.is_dir() and _FOLDER.fullmatch(p.name)}
    found = defaultdict(list)
    for folder in sorted(folders):
        run = load_run(folder)
        found[run["experiment"], run["hash"]].append(run)
    return found


def load_run(folder: Path) -> dict[str, Any]:
    """Metrics, folder and name of a run; with a `problem` in place of metrics if it has none."""
    match = _FOLDER.fullmatch(folder.name)
    seed, config = (int(match[1]), match[2]) if match else (-1, "")
    name = {"folder": folder, "experiment": folder.parent.name, "hash": config, "seed": seed}
    try:
        metrics = read_metrics(folder)
    except DataError as error:
        return {**name, "problem": str(error)}
    if metrics is None:
        begun = any((folder / one).exists() for one in _BEGUN)
        return {**name, "problem": "unfinished" if begun else "no result"}
    return {
        "folder": folder,
        "metrics": metrics,
        **{key: getattr(metrics, key) for key in ("experiment", "hash", "seed")},
    }


def frame(runs: Sequence[Mapping[str, Any]], take: str = "final") -> pd.DataFrame:
    """Runs of `load_runs` as lines; those of unfinished runs have a `problem` and no scores."""
    lines = [record(run["metrics"], take) if "metrics" in run else dict(run) for run in runs]
    return complete(pd.DataFrame(lines).assign(folder=[str(run["folder"]) for run in runs]))


def complete(lines: pd.DataFrame) -> pd.DataFrame:
    """All columns there, with numbers and flags as such and "" for what is not known."""
    columns = ("seed", "experiment", "hash", "problem", "folder", "take", *_NUMBERS)
    lines = lines.reindex(columns=list(dict.fromkeys([*lines.columns, *columns, *_SEEN, *_FLAGS])))
    for name in _NUMBERS:
        lines[name] = pd.to_numeric(lines[name].replace("", np.nan))
    for name in _FLAGS:
        lines[name] = lines[name].astype(str) == "True"
    others = [name for name in lines.columns if name not in (*_NUMBERS, *_FLAGS, "seed")]
    lines[others] = lines[others].astype(object).fillna("")
    return lines.astype({"seed": int})


def write_kept(path: Path, lines: pd.DataFrame) -> None:
    """Write a kept file, atomically; the same lines give the same bytes."""
    text = lines.to_csv(index=False, lineterminator="\n")
    write_bytes(path, gzip.compress(text.encode(), mtime=0))


def read_kept(path: str | Path, target: str | None = None) -> dict[tuple[str, str], pd.DataFrame]:
    """Read a kept file: the lines of each row and column; only those on a target if one is given.

    Raises:
        ConfigError: there is no such file.
        DataError: it cannot be read, or is not one.
    """
    try:
        lines = pd.read_csv(path, dtype=str, keep_default_na=False)
        lines = complete(lines)
        lines = lines if target is None else lines[lines.target == target]
        return dict(iter(lines.groupby(["row", "column"], sort=False)))
    except FileNotFoundError as error:
        raise ConfigError(f"kept={path} is not there; `qs3 report keep` writes it") from error
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"{path} cannot be read ({error})") from error


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
    """Of a line of the frame, or of the predictions in its folder.

    Raises:
        DataError: there are none, or they are damaged.
    """
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
    def of(values: Sequence[float] | pd.Series) -> Stat:
        """From at least one value."""
        series = pd.Series(values, dtype=float)
        sem = float(series.sem()) if len(series) > 1 else None
        return Stat(float(series.mean()), sem, len(series))

    def percent(self) -> str:
        """Such as "64.0 ± 1.0"; without a SEM for a single seed."""
        sem = "" if self.sem is None else f" ± {100 * self.sem:.1f}"
        return f"{100 * self.mean:.1f}{sem}"


class Runs:
    """The runs of one config, and what must not be averaged.

    A failed or unfinished seed is shown and never averaged over silently; runs that saw different
    datasets have no mean at all. Datasets of one recipe, made by machines that round in other ways,
    are one dataset.
    """

    def __init__(self, lines: pd.DataFrame) -> None:
        self.lines = lines.sort_values("seed", kind="stable")
        self.finished = self.lines[self.lines.problem == ""]

    @property
    def seeds(self) -> list[int]:
        """Of the finished runs."""
        return self.finished.seed.tolist()

    @property
    def first(self) -> pd.Series | None:
        """The first finished run, for what all seeds have in common."""
        return None if self.finished.empty else self.finished.iloc[0]

    def stat(self, score: str) -> Stat | None:
        """Mean of one of `SCORES` over seeds; None if nothing may be averaged."""
        values = self.finished[score]
        return None if values.empty or values.isna().any() or self._apart else Stat.of(values)

    @property
    def comparable(self) -> bool:
        """Whether the finished runs may be averaged."""
        return not self._apart

    @property
    def problems(self) -> list[str]:
        """Unfinished or diverged seeds, and why seeds cannot be averaged."""
        failed = self.lines[self.lines.problem != ""]
        found = [f"seed {r.seed}: {r.problem} ({r.folder})" for r in failed.itertuples()]
        if diverged := _list(self.finished[self.finished.diverged].seed):
            found.append(f"seeds {diverged}: the net has diverged, one class for all: averaged")
        return [*found, *self._apart]

    @cached_property
    def _apart(self) -> list[str]:
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
    recipes = lines.get(key.replace("_data", "_recipe"))
    one_recipe = key != "weights" and recipes is not None and recipes.nunique() == 1
    return lines[key].nunique() < 2 or bool(one_recipe and recipes.iloc[0])


def _list(seeds: Iterable[int]) -> str:
    return ", ".join(map(str, seeds))


def task(run: Any) -> str:
    """Such as "specklenet10 -> kinectsim10 (simulated target)"."""
    return f"{run.source} -> {run.target}{' (simulated target)' if run.simulated else ''}"


def data_lines(lines: pd.DataFrame) -> list[str]:
    """What the data of runs are made of: "data: specklenet10: embedded catalogue, ..."; once."""
    parts = [part for text in lines.get("data", ()) for part in str(text).split("; ") if part]
    return [f"data: {part}" for part in dict.fromkeys(parts)]


def summarise(folders: Sequence[Path], settings: Mapping[Path, str] | None = None) -> str:
    """An aligned text table of the runs in `folders`, a line a config; percentages.

    What could not be averaged follows below it. `settings`: by folder how a config differs from
    the others.
    """
    lines = frame([load_run(folder) for folder in folders])
    lines["settings"] = [(settings or {}).get(Path(folder), "") for folder in lines.folder]
    several = bool((lines.settings != "").any())
    header = ["experiment", *["settings"] * several, "source -> target", "method"]
    rows = [[*header, "self-training", "accuracy", "balanced", "seeds", "majority"]]
    notes: list[str] = []
    for key, some in lines.groupby(["experiment", "hash"], sort=False):
        runs = Runs(some)
        first, few = runs.first, 0 < len(runs.seeds) < FEW_SEEDS
        about = ["?"] * 3 if first is None else [task(first), first.method, first.selftraining]
        stats = [runs.stat(name) for name in _NAMES]
        accuracy, balanced = (stat.percent() if stat else "-" for stat in stats[:2])
        majority = f"{100 * stats[2].mean:.1f}" if stats[2] else "-"
        seeds = f"{len(runs.seeds)}{' (!)' if few else ''}"
        shown = [some.settings.iloc[0] or "-"] * several
        rows.append([some.experiment.iloc[0], *shown, *about, accuracy, balanced, seeds, majority])
        name = " ".join(map(str, key))
        if first is not None and not first.labelled:
            notes.append(f"{name}: no target labels, so no accuracy")
        notes += [f"{name}, {said}" for said in runs.problems]
    notes += [f"(!) fewer than {FEW_SEEDS} seeds"] * any("(!)" in row[-2] for row in rows)
    caption = "Accuracy on the target's test split in %, mean ± SEM over seeds."
    return "\n".join([caption, *aligned(rows), *notes, *data_lines(lines)])
