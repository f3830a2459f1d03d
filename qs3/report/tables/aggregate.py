"""Runs grouped over their seeds: mean, SEM, and what must not be averaged.

Runs belong together when experiment and config hash agree (the hash leaves out the seed and
paths). A failed or unfinished seed is shown and never averaged over silently; a group whose runs
saw different datasets has no mean at all.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qs3.evaluation.selection_rules import ORACLE_IN_WORDS, took_target_labels
from qs3.utils.text_table import aligned

FINISHED = "finished"
DIAGNOSTIC = "diagnostic"
FEW_SEEDS = 3
"""Below this number of seeds a mean is marked."""

_FOLDER = re.compile(r"seed(\d+)-([0-9a-f]+)")
_BEGUN = ("started.json", "last.ckpt", ".hydra")
_KEYS = ("experiment", "hash", "seed", "status", "source", "target", "final", "data")


@dataclass(frozen=True)
class Run:
    """One seed of one config, finished or not.

    Attributes:
        folder: of the run.
        experiment: name.
        hash: of the config without its seed.
        seed: None if not known.
        status: "finished", "unfinished", "damaged", or "diagnostic": finished, but its epoch was
            chosen by the target's test labels, so that it is no result.
        metrics: contents of metrics.json; empty unless finished.
        problem: why it is not finished, or no result.
    """

    folder: Path
    experiment: str
    hash: str
    seed: int | None
    status: str
    metrics: Mapping[str, Any]
    problem: str = ""


@dataclass(frozen=True)
class Stat:
    """Mean over seeds with its standard error; values as in metrics.json (0 to 1).

    Attributes:
        mean: of the n values.
        sem: std(ddof=1) / sqrt(n); None for n = 1.
        n: number of seeds.
    """

    mean: float
    sem: float | None
    n: int

    @staticmethod
    def of(values: Sequence[float]) -> Stat:
        """From at least one value."""
        n = len(values)
        mean = math.fsum(values) / n
        if n == 1:
            return Stat(mean, None, 1)
        variance = math.fsum((v - mean) ** 2 for v in values) / (n - 1)
        return Stat(mean, math.sqrt(variance / n), n)

    def percent(self, digits: int = 1) -> str:
        """Such as "64.0 ± 1.0"; without a SEM for a single seed."""
        sem = "" if self.sem is None else f" ± {100 * self.sem:.{digits}f}"
        return f"{100 * self.mean:.{digits}f}{sem}"


@dataclass(frozen=True)
class Group:
    """All seeds of one config.

    Attributes:
        experiment: name.
        hash: of the config.
        finished: runs with a result, by seed.
        problems: for the reader: unfinished seeds, different datasets, a seed twice.
        comparable: whether the finished runs may be averaged.
        diagnostic: whether a run of it was chosen by the target's test labels; none of these is
            among the finished ones.
    """

    experiment: str
    hash: str
    finished: tuple[Run, ...]
    problems: tuple[str, ...]
    comparable: bool
    diagnostic: bool = False

    @property
    def first(self) -> Mapping[str, Any]:
        """Metrics of the first finished run, for what all seeds have in common."""
        return self.finished[0].metrics if self.finished else {}

    @property
    def seeds(self) -> list[int]:
        """Of the finished runs."""
        return [run.seed for run in self.finished if run.seed is not None]

    @property
    def unlabelled(self) -> bool:
        """Whether it was finished on a target without labels, so that there is no accuracy."""
        final = self.first.get("final")
        return isinstance(final, Mapping) and final.get("accuracy", 0.0) is None

    def stat(self, *path: str) -> Stat | None:
        """Mean of `metrics[path[0]][path[1]]...`; None if there is nothing that may be averaged."""
        if not self.finished or not self.comparable:
            return None
        values: list[Any] = []
        for run in self.finished:
            value: Any = run.metrics
            for key in path:
                value = value.get(key) if isinstance(value, Mapping) else None
            values.append(value)
        if any(not isinstance(v, int | float) or not math.isfinite(v) for v in values):
            return None
        return Stat.of(values)


def load_runs(log_dir: str | Path) -> list[Run]:
    """All runs below a folder, however deep, unfinished and damaged ones included."""
    root = Path(log_dir)
    folders = {path.parent for path in root.rglob("metrics.json")}
    folders |= {
        path for path in root.rglob("seed*-*") if path.is_dir() and _FOLDER.fullmatch(path.name)
    }
    return [load_run(folder) for folder in sorted(folders)]


def load_run(folder: str | Path) -> Run:
    """One run's result, or what is known of a run without one."""
    folder = Path(folder)
    match = _FOLDER.fullmatch(folder.name)
    seed, config = (int(match[1]), match[2]) if match else (None, "")
    experiment = folder.parent.name

    def broken(status: str, problem: str) -> Run:
        return Run(folder, experiment, config, seed, status, {}, problem)

    path = folder / "metrics.json"
    if not path.is_file():
        begun = any((folder / name).exists() for name in _BEGUN)
        return broken("unfinished", "unfinished" if begun else "no result")
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        return broken("damaged", f"{path.name} is not readable ({error})")
    missing = [key for key in _KEYS if not isinstance(metrics, dict) or key not in metrics]
    if missing:
        return broken("damaged", f"{path.name} has no {', '.join(missing)}")
    if metrics["status"] != FINISHED:
        return broken("unfinished", str(metrics["status"]))
    if took_target_labels(metrics):
        why = f"left out, because its student was chosen by the {ORACLE_IN_WORDS}"
        return Run(
            folder, metrics["experiment"], metrics["hash"], metrics["seed"], DIAGNOSTIC, {}, why
        )
    return Run(folder, metrics["experiment"], metrics["hash"], metrics["seed"], FINISHED, metrics)


def group(runs: Iterable[Run]) -> list[Group]:
    """Runs by (experiment, hash), in the order in which these first appear."""
    by_config: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        by_config[run.experiment, run.hash].append(run)
    return [_group(key, members) for key, members in by_config.items()]


def _group(key: tuple[str, str], runs: Sequence[Run]) -> Group:
    finished = sorted((r for r in runs if r.status == FINISHED), key=lambda r: r.seed or 0)
    problems = [
        f"seed {'?' if run.seed is None else run.seed}: {run.problem} ({run.folder})"
        for run in runs
        if run.status != FINISHED
    ]
    comparable = True
    twice = sorted(seed for seed, n in Counter(r.seed for r in finished).items() if n > 1)  # type: ignore[type-var]
    if twice:
        comparable = False
        problems.append(f"seeds {_list(twice)} occur more than once: not averaged")
    for role in ("source", "target"):
        hashes = defaultdict(list)
        for run in finished:
            hashes[str(run.metrics["data"].get(role))].append(run.seed)
        if len(hashes) > 1:
            comparable = False
            seen = "; ".join(f"seeds {_list(seeds)}: {sha[:12]}" for sha, seeds in hashes.items())
            problems.append(f"the {role} dataset differs ({seen}): not averaged")
    diagnostic = any(run.status == DIAGNOSTIC for run in runs)
    return Group(*key, tuple(finished), tuple(problems), comparable, diagnostic)


def _list(seeds: Sequence[int | None]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def task(metrics: Mapping[str, Any]) -> str:
    """Such as "specklenet10 -> kinectsim10 (simulated target)"."""
    simulated = " (simulated target)" if metrics.get("simulated") else ""
    return f"{metrics.get('source', '?')} -> {metrics.get('target', '?')}{simulated}"


def summarise(folders: list[Path], settings: Mapping[Path, str] | None = None) -> str:
    """An aligned text table of the runs in `folders`, a line a config; percentages.

    What could not be averaged follows below the table, with its reason.

    Args:
        folders: of the runs.
        settings: by folder in what a config differs from the others of the table.
    """
    settings = settings or {}
    runs = [load_run(folder) for folder in folders]
    groups = group(runs)
    differs = {(run.experiment, run.hash): settings.get(run.folder, "") for run in runs}
    several = any(differs.values())
    header: tuple[str, ...] = (
        "experiment", *(["settings"] if several else []), "source -> target", "method",
        "self-training",
        "accuracy", "balanced", "seeds", "majority",
    )  # fmt: skip
    lines, notes = [header], []
    for g in groups:
        accuracy, balanced = g.stat("final", "accuracy"), g.stat("final", "balanced_accuracy")
        majority = g.stat("final", "majority_rate")
        few = 0 < len(g.finished) < FEW_SEEDS
        problems = [f"{g.experiment} {g.hash}, {problem}" for problem in g.problems]
        if g.diagnostic and not g.finished:
            notes += problems
            continue
        lines.append(
            (
                g.experiment,
                *([differs[g.experiment, g.hash] or "-"] if several else []),
                task(g.first) if g.first else "?",
                str(g.first.get("method", "?")),
                str(g.first.get("selftraining", "?")),
                accuracy.percent() if accuracy else "-",
                balanced.percent() if balanced else "-",
                f"{len(g.finished)}{' (!)' if few else ''}",
                f"{100 * majority.mean:.1f}" if majority else "-",  # of the data: no SEM
            )
        )
        if g.unlabelled:
            notes.append(f"{g.experiment} {g.hash}: no target labels, so no accuracy")
        notes += problems
    if any("(!)" in line[-2] for line in lines):
        notes.append(f"(!) fewer than {FEW_SEEDS} seeds")
    caption = "Accuracy on the target's test split in %, mean ± SEM over seeds."
    return "\n".join([caption, *aligned(lines), *notes])
