"""Runs, objects, predictions, figures: what `qs3 report judge` finds out.

The archive is read by `qs3.datasets.importers.object_archive`; its clouds go to each run as those
of
`qs3 predict` do, thinned to the points that the run was trained with (`qs3.report.judge.answers`).
Nothing is trained, chosen or tuned by what comes out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from qs3.classes import known_as
from qs3.config.checks import check_float
from qs3.datasets.importers.object_archive import JUDGE, TIERS, Archive, read_archive
from qs3.errors import ConfigError, DataError
from qs3.evaluation.prior import POWER, check_told
from qs3.inference.pretrained import name_of
from qs3.report.judge.answers import (
    Answers,
    answers_of,
    asked_of,
    check_keepable,
    find_runs,
    keep_answers,
)
from qs3.report.judge.intervals import Share, difference, share
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.utils.version import VERSION, commit, in_words

BLOCK = 30
"""Frames in a row that make a cluster."""


@dataclass(frozen=True)
class Figures:
    """Figures of one family of runs on one tier of objects.

    Attributes:
        tier: "all", "clean" or "hard".
        n, blocks: objects, and blocks of frames they come from.
        accuracy, balanced: with their intervals; balanced over the classes that are there.
        majority: what always naming the commonest class would reach.
        counts: objects of each class that is there.
        recall: of each of them, the mean over seeds.
        predicted: objects called each class, the mean over seeds.
        alone: classes whose objects are all of one block: with them the interval of `balanced` is
            too narrow, see `qs3.report.judge.intervals`.
    """

    tier: str
    n: int
    blocks: int
    accuracy: Share
    balanced: Share
    majority: float
    counts: dict[str, int]
    recall: dict[str, float]
    predicted: dict[str, float]
    alone: tuple[str, ...]


@dataclass(frozen=True)
class Family:
    """Runs of one config, one a seed.

    Attributes:
        name: of the experiment with the config's hash; or of a classifier that comes with qs3; or
            the run's path.
        runs: their result files.
        seeds: theirs; empty where not known.
        points: of a cloud as the nets see it.
        target: what they were adapted to.
        data: what both domains are made of; "" where not known.
        trained_by: versions of qs3, and commits if it was a checkout; "" where not known.
        figures: by tier.
    """

    name: str
    runs: tuple[Path, ...]
    seeds: tuple[int, ...]
    points: int
    target: str
    data: str
    trained_by: str
    figures: tuple[Figures, ...]


@dataclass(frozen=True)
class Difference:
    """One family less the first, on one tier.

    Attributes:
        name, base: of the two.
        tier: of the objects.
        seeds: that both have; below two the interval is over blocks alone.
        accuracy, balanced: in [-1, 1].
    """

    name: str
    base: str
    tier: str
    seeds: int
    accuracy: Share
    balanced: Share


@dataclass(frozen=True)
class Verdict:
    """All of it.

    Attributes:
        data, sha256: the archive.
        part: of its `dev` that was judged on; "" for all.
        classes: that were judged.
        left_out: objects of other classes.
        inliers_only: whether stray points were left out.
        floor: z of the floor, for nets that know heights; None: as in the target of each.
        prior, prior_power: how common classes counted as in the second half of the families; "":
            there is no such half.
        families: in the order of the runs given.
        differences: of the others to the first of them.
        judged_by: version of qs3, and the commit of a checkout.
    """

    data: Path
    sha256: str
    part: str
    classes: tuple[str, ...]
    left_out: int
    inliers_only: bool
    floor: float | None
    prior: str
    prior_power: float
    families: tuple[Family, ...]
    differences: tuple[Difference, ...]
    judged_by: str


def judge(
    runs: Sequence[str],
    data: Path,
    *,
    classes: Sequence[str] = (),
    part: str = "",
    inliers_only: bool = True,
    floor: float | None = None,
    device: str = "cpu",
    keep: Path | None = None,
    prior: str = "",
    prior_power: float = POWER,
) -> Verdict:
    """Judge saved runs on an archive of objects.

    Args:
        runs: folders of runs, folders of such folders, patterns, result files, or what `keep` kept.
        data: the .npz.
        classes: only objects of these; none: of all that every run knows.
        part: of its `dev`; none: "judge", where it has one, else all.
        inliers_only: leave points out that the archive marks as stray.
        floor: z of the floor in the archive, minus its camera's height, for nets that know heights;
            None: as in the target of each.
        device: of the nets.
        keep: a folder that gets what each net called each object, for `runs` of another day; of
            each run one archive's and one question's.
        prior, prior_power: how common classes are in the archive's place, and how much of that is
            believed (`qs3.evaluation.prior`): each family is judged without it and with it. "":
            only without, also of runs that were evaluated with a prior.

    Raises:
        MissingDataError: a run or the archive is not there.
        DataError: one is damaged.
        ConfigError: nothing is left to judge on, runs cannot be judged so, or `keep` has answers to
            something else.
    """
    check_told(prior, prior_power)
    check_float("prior_power", prior_power, ">= 0")
    if floor is not None:
        check_float("floor", floor)
    archive = read_archive(data)
    chosen, part = _chosen(archive, part)
    asks = [
        asked_of(archive, part, inliers_only, floor, *told)
        for told in [("", POWER), (prior, prior_power)][: 1 + bool(prior)]
    ]
    files = [find_runs(runs, part, asked.prior) for asked in asks]
    if keep is not None:
        for asked, some in zip(asks, files, strict=True):
            check_keepable(some, keep, asked)
    found = [
        answers_of(some, archive, chosen, asked, device)
        for asked, some in zip(asks, files, strict=True)
    ]
    if keep is not None:
        for answers in found:
            keep_answers(answers, keep)
    common = _common([one.classes for answers in found for one in answers.values()], classes)
    names = [known_as(str(name), common) for name in archive.cls]
    kept = [i for i in chosen if names[i] is not None]
    if not kept:
        raise ConfigError(f"{data}: no object of {', '.join(common)} in what was asked for")
    truth = np.array([common.index(str(names[i])) for i in kept])
    blocks, tiers = archive.frame[kept] // BLOCK, archive.tier[kept]
    every = np.ones(len(kept), dtype=bool)
    subsets = {"all": every, **{tier: tiers == tier for tier in TIERS if (tiers == tier).any()}}
    families, differences = [], []
    base: tuple[Family, np.ndarray] | None = None
    for asked, answers in zip(asks, found, strict=True):
        for known in _families(list(answers)):
            picked = np.stack([_called(answers[file], common, kept, file) for file in known.runs])
            first = answers[known.runs[0]]
            figures = tuple(
                _figures(tier, picked[:, of], truth[of], blocks[of], common)
                for tier, of in subsets.items()
            )
            family = Family(
                known.name + f", prior={asked.prior}" * bool(asked.prior),
                known.runs,
                known.seeds,
                first.points,
                first.target,
                known.data,
                known.trained_by,
                figures,
            )
            families.append(family)
            right = picked == truth
            base = base or (families[0], right)
            if len(families) > 1:
                differences += _differences(families[-1], right, *base, truth, blocks, subsets)
    left_out = len(chosen) - len(kept)
    return Verdict(
        data,
        asks[0].sha256,
        part,
        common,
        left_out,
        inliers_only,
        floor,
        prior,
        prior_power,
        tuple(families),
        tuple(differences),
        in_words(VERSION, commit()),
    )


def _differences(
    family: Family,
    right: np.ndarray,
    base: Family,
    base_right: np.ndarray,
    truth: np.ndarray,
    blocks: np.ndarray,
    subsets: Mapping[str, np.ndarray],
) -> list[Difference]:
    """A family less the base on each tier, over the seeds that both have where there are any."""
    common = sorted({*family.seeds} & {*base.seeds})
    if common:
        right = right[[family.seeds.index(seed) for seed in common]]
        base_right = base_right[[base.seeds.index(seed) for seed in common]]
    return [
        Difference(
            family.name,
            base.name,
            tier,
            len(common),
            *(
                difference(
                    *(right[:, of], base_right[:, of], truth[of], blocks[of]),
                    balanced=balanced,
                    same_seeds=bool(common),
                )
                for balanced in (False, True)
            ),
        )
        for tier, of in subsets.items()
    ]


def _called(answers: Answers, common: Sequence[str], kept: Sequence[int], file: Path) -> np.ndarray:
    """A position in `common` for each object, or -1 for another class."""
    of = dict(zip(answers.objects, answers.called, strict=True))
    if missing := [i for i in kept if i not in of]:
        raise DataError(f"{file} has no answer to object {missing[0]} of the archive")
    place = [common.index(name) if name in common else -1 for name in answers.classes]
    return np.array([place[of[i]] for i in kept])


class _Known(NamedTuple):
    """Runs of one config that saw the same data, and what their results say; see `Family`."""

    name: str
    runs: tuple[Path, ...]
    seeds: tuple[int, ...] = ()
    data: str = ""
    trained_by: str = ""


def _families(files: Sequence[Path]) -> list[_Known]:
    """The runs of each config that saw the same data.

    Raises:
        ConfigError: a seed is there twice.
    """
    members: dict[tuple[str, ...], dict[int, tuple[Path, RunMetrics]]] = {}
    found: dict[tuple[str, ...], _Known] = {}
    for file in files:
        metrics = read_metrics(file.parent)
        if metrics is None:
            found[(str(file),)] = _Known(name_of(file) or str(file), (file,))
            continue
        key = (metrics.experiment, metrics.hash, *metrics.seen.values())
        of = members.setdefault(key, {})
        if metrics.seed in of:
            other = of[metrics.seed][0].parent
            raise ConfigError(f"{file.parent} and {other} are the same run twice; give one")
        of[metrics.seed] = file, metrics
        found[key] = _known(of)
    return list(found.values())


def _known(of: Mapping[int, tuple[Path, RunMetrics]]) -> _Known:
    seeds = tuple(sorted(of))
    runs, metrics = zip(*(of[seed] for seed in seeds), strict=True)
    by = {in_words(m.versions.get("qs3", "?"), m.versions.get("commit", "")) for m in metrics}
    name = f"{metrics[0].experiment} {metrics[0].hash}"
    return _Known(name, runs, seeds, metrics[0].data_text, "; ".join(sorted(by)))


def _chosen(archive: Archive, part: str) -> tuple[list[int], str]:
    """Positions of the objects of a part, and the part."""
    if not part and JUDGE in archive.parts:
        part = JUDGE
    return (archive.of_part(part), part) if part else (list(range(len(archive))), "")


def _common(of_runs: Sequence[tuple[str, ...]], wanted: Sequence[str]) -> tuple[str, ...]:
    """The classes that every run knows, in the order of the first; those wanted alone."""
    common = tuple(name for name in of_runs[0] if all(name in one for one in of_runs))
    if unknown := [name for name in wanted if name not in common]:
        raise ConfigError(
            f"classes={','.join(unknown)}: not known to every run; those are {', '.join(common)}"
        )
    if not common:
        raise DataError("the runs have no class in common")
    return tuple(name for name in common if not wanted or name in wanted)


def _figures(
    tier: str,
    guesses: Int[np.ndarray, "s n"],
    truth: Int[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> Figures:
    right: Bool[np.ndarray, "s n"] = guesses == truth
    counts = np.bincount(truth, minlength=len(names))
    there = [k for k, count in enumerate(counts) if count]
    return Figures(
        tier,
        len(truth),
        len(np.unique(blocks)),
        share(right, truth, blocks),
        share(right, truth, blocks, balanced=True),
        float(counts.max() / len(truth)),
        {names[k]: int(counts[k]) for k in there},
        {names[k]: float(right[:, truth == k].mean()) for k in there},
        {names[k]: float((guesses == k).sum(axis=1).mean()) for k in range(len(names))},
        tuple(names[k] for k in there if len(np.unique(blocks[truth == k])) == 1),
    )
