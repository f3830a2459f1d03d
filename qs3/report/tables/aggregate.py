"""Runs grouped over their seeds: mean, SEM, and what must not be averaged.

Runs belong together when experiment and config hash agree (the hash leaves out the seed and
paths). A failed or unfinished seed is shown and never averaged over silently; a group whose runs
saw different datasets has no mean at all. Renderings of one recipe by different machines, which
differ by rounding, are one dataset; a line below the table says so.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from qs3.datasets.importers.object_archive import TIERS
from qs3.errors import DataError
from qs3.runs.folder import read_code
from qs3.runs.metrics import FINISHED, METRICS, RunMetrics, Scores, read_metrics
from qs3.store.meta import MadeOf
from qs3.utils.text_table import aligned

FEW_SEEDS = 3
"""Below this number of seeds a mean is marked."""

FOLDER = re.compile(r"seed(\d+)-([0-9a-f]+)")
_BEGUN = ("started.json", "last.ckpt", ".hydra")


@dataclass(frozen=True)
class Run:
    """One seed of one config, finished or not.

    Attributes:
        folder: of the run.
        experiment: name.
        hash: of the config without its seed.
        seed: None if not known.
        status: "finished", "unfinished" or "damaged".
        metrics: contents of metrics.json; None unless finished.
        problem: why it is not finished.
    """

    folder: Path
    experiment: str
    hash: str
    seed: int | None
    status: str
    metrics: RunMetrics | None
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
        problems: for the reader: unfinished or diverged seeds, different datasets, a seed twice.
        comparable: whether the finished runs may be averaged.
        notes: for the reader, too: what is odd, but lets no seed be missing or not fit.
    """

    experiment: str
    hash: str
    finished: tuple[Run, ...]
    problems: tuple[str, ...]
    comparable: bool
    notes: tuple[str, ...] = ()

    @property
    def results(self) -> list[RunMetrics]:
        """Metrics of the finished runs, by seed."""
        return [run.metrics for run in self.finished if run.metrics is not None]

    @property
    def first(self) -> RunMetrics | None:
        """Metrics of the first finished run, for what all seeds have in common."""
        return next(iter(self.results), None)

    @property
    def seeds(self) -> list[int]:
        """Seeds of the finished runs."""
        return [run.seed for run in self.finished if run.seed is not None]

    @property
    def unlabelled(self) -> bool:
        """Whether it was finished on a target without labels, so that there is no accuracy."""
        return self.first is not None and self.first.final.accuracy is None

    def stat(self, score: str, take: str = "final") -> Stat | None:
        """Mean of a score over seeds, see `value_of`; None if nothing may be averaged."""
        if not self.results or not self.comparable:
            return None
        values = [value_of(result, score, take) for result in self.results]
        known = [value for value in values if value is not None]
        return Stat.of(known) if len(known) == len(values) else None


def value_of(metrics: RunMetrics, score: str, take: str = "final") -> float | None:
    """A run's score by the name of a table's metric.

    Args:
        score: of `Scores`; with "_clean" or "_hard" behind it of that tier, for "final" alone.
        take: "final", or "warmup" for the teacher of round 0.
    """
    name, _, tier = score.rpartition("_")
    if tier not in TIERS:
        found: float | None = getattr(scores_of(metrics, take), score)
        return found
    tiers = (metrics.evaluation.tiers or {}) if take == "final" else {}
    return getattr(tiers[tier], name) if tier in tiers else None


def scores_of(metrics: RunMetrics, take: str = "final") -> Scores:
    """The reported scores, or ("warmup") those of the teacher of round 0."""
    return metrics.final if take == "final" else metrics.warmup.selected.scores


def load_runs(log_dir: str | Path) -> list[Run]:
    """All runs below a folder, however deep, unfinished and damaged ones included."""
    root = Path(log_dir)
    folders = {path.parent for path in root.rglob(METRICS)}
    folders |= {
        path for path in root.rglob("seed*-*") if path.is_dir() and FOLDER.fullmatch(path.name)
    }
    return [load_run(folder) for folder in sorted(folders)]


def load_run(folder: str | Path) -> Run:
    """One run's result, or what is known of a run without one."""
    folder = Path(folder)
    match = FOLDER.fullmatch(folder.name)
    seed, config = (int(match[1]), match[2]) if match else (None, "")
    experiment = folder.parent.name

    def without(status: str, problem: str) -> Run:
        return Run(folder, experiment, config, seed, status, None, problem)

    try:
        metrics = read_metrics(folder)
    except DataError as error:
        return without("damaged", str(error))
    if metrics is None:
        begun = any((folder / name).exists() for name in _BEGUN)
        return without("unfinished", "unfinished" if begun else "no result")
    return Run(folder, metrics.experiment, metrics.hash, metrics.seed, FINISHED, metrics)


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
    comparable, notes = True, []
    twice = sorted(seed for seed, n in Counter(r.seed for r in finished).items() if n > 1)  # type: ignore[type-var]
    if twice:
        comparable = False
        places = ", ".join(str(run.folder) for run in finished if run.seed in twice)
        problems.append(f"seeds {_list(twice)} occur more than once ({places}): not averaged")
    diverged = [run.seed for run in finished if run.metrics and run.metrics.diverged]
    if diverged:
        problems.append(
            f"seeds {_list(diverged)}: the net has diverged and calls every cloud alike: averaged"
        )
    for role, what in _ROLES.items():
        hashes = defaultdict(list)
        for run in finished:
            hashes[run.metrics.seen[role] if run.metrics else ""].append(run.seed)
        if len(hashes) > 1:
            seen = "; ".join(f"seeds {_list(seeds)}: {sha[:12]}" for sha, seeds in hashes.items())
            if role in _DATASETS and same_data((run.metrics for run in finished), role):
                notes.append(
                    f"the {role} was made by one recipe on several machines, whose bytes differ by "
                    f"rounding ({seen}): averaged"
                )
                continue
            comparable = False
            problems.append(f"{what} ({seen}): not averaged")
    notes += _other_code(finished)
    return Group(*key, tuple(finished), tuple(problems), comparable, tuple(notes))


def _other_code(runs: Sequence[Run]) -> list[str]:
    """Which code was edited between seeds, as far as the runs say what theirs was.

    What is called alike is compared: another machine has one's own nets in another folder.
    """
    seeds: defaultdict[str, defaultdict[str, list[int | None]]]
    seeds = defaultdict(lambda: defaultdict(list))
    for run in runs:
        for name, sha256 in read_code(run.folder).items():
            seeds[name][sha256].append(run.seed)
    return [
        f"{name} was edited between seeds {' and '.join(map(_list, by_code.values()))}: averaged"
        for name, by_code in seeds.items()
        if len(by_code) > 1
    ]


_DATASETS = ("source", "target")
_ROLES = {
    **{role: f"the {role} dataset differs" for role in _DATASETS},
    "beside": "twins or views of the source differ",
    "weights": "the classifier that they began with differs",
}


def same_data(results: Iterable[RunMetrics | None], role: str) -> bool:
    """Whether runs saw the same dataset: the same bytes, or made by the same recipe.

    Args:
        results: of the runs; None is passed over.
        role: "source" or "target".
    """
    known = [result for result in results if result]
    recipes = {getattr(result.made_of, role).recipe for result in known}
    return len({getattr(result.data, role) for result in known}) < 2 or (
        len(recipes) == 1 and "" not in recipes
    )


def data_differences(results: Iterable[RunMetrics], role: str) -> str:
    """What tells the datasets of runs apart: their names, or of one name the hashes and recipes.

    Args:
        results: of runs that did not see the same data, see `same_data`.
        role: "source" or "target".
    """
    runs = list(results)
    names = list(dict.fromkeys(getattr(run, role) for run in runs))
    if len(names) > 1:
        return f"the runs have different {role}s: {' and '.join(names)}"
    seen = {getattr(run.data, role)[:12]: str(getattr(run.made_of, role)) for run in runs}
    versions = [f"{sha} ({made})" for sha, made in seen.items()]
    if len(set(seen.values())) == 1:
        versions = list(seen)
    return f"the runs saw different versions of {names[0]}: {' and '.join(versions)}"


def _list(seeds: Sequence[int | None]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def task(metrics: RunMetrics) -> str:
    """Such as "specklenet10 -> kinectsim10 (simulated target)"."""
    simulated = " (simulated target)" if metrics.simulated else ""
    return f"{metrics.source} -> {metrics.target}{simulated}"


def data_lines(results: Iterable[RunMetrics]) -> list[str]:
    """What the data of runs are made of: "specklenet10: embedded catalogue, ..."; each once.

    A benchmark's train part was once called "like it": of the same bytes the other words count.
    """
    found: dict[tuple[str, str, str], MadeOf] = {}
    for r in results:
        domains = r.domains
        hashes = (r.data.source, r.data.target)[-len(domains) :]  # two of one name may be one
        for (name, made), sha in zip(domains.items(), hashes, strict=True):
            key = (name, sha, str(replace(made, benchmark="")))
            if key not in found or found[key].benchmark.startswith("like "):
                found[key] = made
    return list(dict.fromkeys(f"data: {key[0]}: {made}" for key, made in found.items()))


def summarise(folders: list[Path], settings: Mapping[Path, str] | None = None) -> str:
    """An aligned text table of the runs in `folders`, a line a config; percentages.

    What could not be averaged follows below the table, with its reason. `settings`: by folder how
    a config differs from the others of the table.
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
        first, stats = g.first, [g.stat(name) for name in ("accuracy", "balanced_accuracy")]
        majority, few = g.stat("majority_rate"), 0 < len(g.finished) < FEW_SEEDS
        about = (task(first), first.method, first.selftraining) if first else ("?", "?", "?")
        lines.append(
            (
                g.experiment,
                *([differs[g.experiment, g.hash] or "-"] if several else []),
                *about,
                *(stat.percent() if stat else "-" for stat in stats),
                f"{len(g.finished)}{' (!)' if few else ''}",
                f"{100 * majority.mean:.1f}" if majority else "-",  # of the data: no SEM
            )
        )
        if g.unlabelled:
            notes.append(f"{g.experiment} {g.hash}: no target labels, so no accuracy")
        notes += [f"{g.experiment} {g.hash}, {problem}" for problem in (*g.problems, *g.notes)]
    if any("(!)" in line[-2] for line in lines):
        notes.append(f"(!) fewer than {FEW_SEEDS} seeds")
    notes += data_lines(result for g in groups for result in g.results)
    caption = "Accuracy on the target's test split in %, mean ± SEM over seeds."
    return "\n".join([caption, *aligned(lines), *notes])
