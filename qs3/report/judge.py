"""Saved runs judged on an archive of real objects that they were not trained on.

Accuracies with intervals: objects of one room are not independent, so blocks of frames in a row are
clusters, and seeds vary, too (`qs3.report.intervals`). Each cloud is thinned to the points that the
run was trained with. Nothing is trained, chosen or tuned by what comes out.
"""

from __future__ import annotations

import dataclasses
import glob
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from qs3.classes import known_as
from qs3.datasets.object_archive import JUDGE, TIERS, Archive, read_archive
from qs3.errors import ConfigError, MissingDataError
from qs3.inference.model_file import FILE, find_result
from qs3.inference.predictor import Predictor, load
from qs3.inference.pretrained import name_of
from qs3.report.intervals import Interval, difference, share
from qs3.runs.metrics import read_metrics
from qs3.utils.files import sha256_file
from qs3.utils.progress import progress_bar
from qs3.utils.text_table import aligned
from qs3.utils.version import VERSION, commit, in_words

BLOCK = 30
"""Frames in a row that make a cluster."""


@dataclass(frozen=True)
class Family:
    """Runs of one config that saw the same data, one a seed.

    Attributes:
        name: experiment and hash; or of a classifier that comes with qs3; or the run's path.
        runs: their result files.
        seeds: theirs; empty where not known.
        data: what both domains are made of; "" where not known.
        trained_by: versions of qs3, and commits if it was a checkout; "" where not known.
        prior: how common classes counted as; "": as in training.
    """

    name: str
    runs: tuple[Path, ...]
    seeds: tuple[int, ...] = ()
    data: str = ""
    trained_by: str = ""
    prior: str = ""


@dataclass(frozen=True)
class Figures:
    """Figures of one family on one tier of objects.

    Attributes:
        family: of runs.
        tier: "all", "clean" or "hard".
        n, blocks: objects, and blocks of frames they come from.
        accuracy, balanced: with their intervals; balanced over the classes that are there.
        majority: what always naming the commonest class would reach.
        counts: objects of each class that is there.
        recall: of each of them, the mean over seeds.
        alone: classes whose objects are all of one block: with them the interval of `balanced` is
            too narrow.
        more: accuracy and balanced accuracy less the first family's, paired object by object; None
            for the first.
    """

    family: Family
    tier: str
    n: int
    blocks: int
    accuracy: Interval
    balanced: Interval
    majority: float
    counts: Mapping[str, int]
    recall: Mapping[str, float]
    alone: tuple[str, ...]
    more: tuple[Interval, Interval] | None = None


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
        figures: by family and tier.
        judged_by: version of qs3, and the commit of a checkout.
    """

    data: Path
    sha256: str
    part: str
    classes: tuple[str, ...]
    left_out: int
    inliers_only: bool
    floor: float | None
    figures: tuple[Figures, ...]
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
    prior: str = "",
    prior_power: float = 0.5,
) -> Verdict:
    """Judge saved runs on an archive of objects.

    Args:
        runs: folders of runs, folders of such folders, patterns, or result files.
        data: the .npz.
        classes: only objects of these; none: of all that every run knows.
        part: of its `dev`; none: "judge", where it has one, else all.
        inliers_only: leave points out that the archive marks as stray.
        floor: z of the floor in the archive, minus its camera's height, for nets that know heights;
            None: as in the target of each.
        device: of the nets.
        prior, prior_power: how common classes are in the archive's place, and how much of that is
            believed (`qs3.evaluation.prior`): each family is judged without it and with it.

    Raises:
        MissingDataError: a run or the archive is not there.
        DataError: one is damaged.
        ConfigError: nothing is left to judge on, or runs cannot be judged so.
    """
    archive = read_archive(data)
    part = part or (JUDGE if JUDGE in archive.parts else "")
    chosen = archive.of_part(part) if part else list(range(len(archive)))
    families = _families(find_runs(runs))
    nets = {
        (file, one): _load(file, one, prior_power, floor, device)
        for one in ("", prior)[: 1 + bool(prior)]
        for family in families
        for file in family.runs
    }
    first = next(iter(nets.values())).classes
    common = tuple(name for name in first if all(name in net.classes for net in nets.values()))
    if unknown := {*classes} - {*common}:
        raise ConfigError(f"classes: {', '.join(sorted(unknown))} is not known to every run")
    common = tuple(name for name in common if not classes or name in classes)
    names = [known_as(str(name), common) for name in archive.cls]
    kept = [i for i in chosen if names[i] is not None]
    if not kept:
        raise ConfigError(f"{data} has no objects of {', '.join(common)} in what was asked for")
    called = _called(nets, archive, kept, common, inliers_only, floor)
    if prior:
        families += [replace(f, name=f"{f.name}, prior={prior}", prior=prior) for f in families]
    truth = np.array([common.index(str(names[i])) for i in kept])
    blocks, tiers = archive.frame[kept] // BLOCK, archive.tier[kept]
    subsets = {"all": np.ones(len(kept), dtype=bool)}
    subsets |= {tier: tiers == tier for tier in TIERS if (tiers == tier).any()}
    figures = []
    guesses = [np.stack([called[file, f.prior] for file in f.runs]) for f in families]
    for family, guess in zip(families, guesses, strict=True):
        for tier, of in subsets.items():
            found = _figures(family, tier, guess[:, of], truth[of], blocks[of], common)
            if family is not families[0]:
                a, b = _paired(family, guess == truth, families[0], guesses[0] == truth)
                some = ((a - b)[:, of], truth[of], blocks[of])
                more = difference(*some), difference(*some, balanced=True)
                found = replace(found, more=more)
            figures.append(found)
    return Verdict(
        data,
        sha256_file(archive.path),
        part,
        common,
        len(chosen) - len(kept),
        inliers_only,
        floor,
        tuple(figures),
        in_words(VERSION, commit()),
    )


def _load(file: Path, prior: str, power: float, floor: float | None, device: str) -> Predictor:
    """The classifier of a run, for clouds with z up and, if it knows heights, a known floor."""
    net = load(file, device=device, prior=prior or None, prior_power=power)
    if net.result.gravity != "z":
        raise ConfigError(f"{file} was trained on clouds in the frame of their camera, not z up")
    if net.needs_floor and net.camera_height is None and floor is None:
        raise ConfigError(f"{file} knows heights above the floor; give floor=-CAMERA_HEIGHT")
    return net


def _called(
    nets: Mapping[tuple[Path, str], Predictor],
    archive: Archive,
    kept: Sequence[int],
    common: Sequence[str],
    inliers_only: bool,
    floor: float | None,
) -> dict[tuple[Path, str], np.ndarray]:
    """A position in `common` for each object by each net, or -1 for another class."""
    clouds = [archive.cloud(i, inliers_only) for i in kept]
    names = [f"{archive.path.name}[{i}]" for i in kept]
    found = {}
    with progress_bar("judging runs", total=len(nets)) as advance:
        for key, net in nets.items():
            place = [common.index(name) if name in common else -1 for name in net.classes]
            found[key] = np.array(place)[net(clouds, names=names, floor=floor).argmax(axis=1)]
            advance()
    return found


def find_runs(runs: Sequence[str]) -> list[Path]:
    """The result files that are meant, each once, in order; see `judge`.

    Raises:
        MissingDataError: one is not there.
    """
    found: dict[Path, None] = {}
    for words in runs:
        place = Path(words).expanduser()
        places = sorted(map(Path, glob.glob(str(place)))) if glob.has_magic(words) else [place]
        if place.exists():
            places = [place]
        if not places:
            raise MissingDataError(f"runs={words} matches nothing")
        for one in places:
            files = sorted(one.rglob(FILE)) if one.is_dir() else []
            found |= dict.fromkeys(map(find_result, files or [one]))
    return list(found)


def _families(files: Sequence[Path]) -> list[Family]:
    """The runs of each config that saw the same data."""
    members: dict[tuple[str, ...], dict[int, Any]] = {}
    for file in files:
        metrics = read_metrics(file.parent)
        key = (str(file),) if metrics is None else (
            metrics.experiment, metrics.hash, *metrics.seen.values()
        )  # fmt: skip
        of = members.setdefault(key, {})
        seed = -1 if metrics is None else metrics.seed
        if seed in of:
            raise ConfigError(f"{file.parent} and {of[seed][0].parent} are the same run twice")
        of[seed] = file, metrics
    found = []
    for of in members.values():
        seeds = tuple(sorted(of))
        runs, results = zip(*(of[seed] for seed in seeds), strict=True)
        if (first := results[0]) is None:
            found.append(Family(name_of(runs[0]) or str(runs[0]), runs))
            continue
        by = {in_words(m.versions.get("qs3", "?"), m.versions.get("commit", "")) for m in results}
        name = f"{first.experiment} {first.hash}"
        found.append(Family(name, runs, seeds, first.data_text, "; ".join(sorted(by))))
    return found


def _paired(
    family: Family, right: np.ndarray, base: Family, base_right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether both are right by common seed and object; without common seeds means over seeds."""
    if common := sorted({*family.seeds} & {*base.seeds}):
        return (
            right[[family.seeds.index(seed) for seed in common]].astype(float),
            base_right[[base.seeds.index(seed) for seed in common]].astype(float),
        )
    return right.mean(axis=0, keepdims=True), base_right.mean(axis=0, keepdims=True)


def _figures(
    family: Family,
    tier: str,
    guesses: Int[np.ndarray, "s n"],
    truth: Int[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> Figures:
    right = guesses == truth
    counts = np.bincount(truth, minlength=len(names))
    there = [k for k, count in enumerate(counts) if count]
    return Figures(
        family,
        tier,
        len(truth),
        len(np.unique(blocks)),
        share(right, truth, blocks),
        share(right, truth, blocks, balanced=True),
        float(counts.max() / len(truth)),
        {names[k]: int(counts[k]) for k in there},
        {names[k]: float(right[:, truth == k].mean()) for k in there},
        tuple(names[k] for k in there if len(np.unique(blocks[truth == k])) == 1),
    )


def text(v: Verdict) -> str:
    """Tables: a row a family and tier, with differences to the first family; a row a class."""
    base = v.figures[0].family
    several = any(f.more for f in v.figures)
    less = [f"accuracy less {base.name}", "balanced less its"] * several
    head = ["run", "seeds", "tier", "objects", "blocks", "accuracy %", "balanced %", "majority %"]
    rows = [[*head, *less]]
    for f in v.figures:
        shown = [_percent(f.accuracy), _percent(f.balanced), f"{100 * f.majority:.1f}"]
        seeds = ",".join(map(str, f.family.seeds)) or "?"
        more = [_percent(one, "+") for one in f.more or ()] or [""] * len(less)
        rows.append([f.family.name, seeds, f.tier, str(f.n), str(f.blocks), *shown, *more])
    part = f", part {v.part}" if v.part else ""
    floor = "" if v.floor is None else f"; the floor lies at {v.floor:g} m"
    lines = [
        f"{v.data}{part}: real objects; stray points {'left out' if v.inliers_only else 'kept'}"
        f"{floor}; {v.left_out} objects of other classes left out",
        *aligned(rows),
        "Mean ± SEM over seeds; in brackets the interval at 95 %, with blocks of frames as clusters"
        " and, of several runs, seeds.",
    ]
    if any(f.more and f.more[0].seeds < 2 for f in v.figures):
        lines.append("(!) fewer than two common seeds: the difference's interval is over blocks")
    for f in v.figures:
        if f.family is base and f.alone and f.blocks > 1:
            lines.append(
                f"(!) {', '.join(f.alone)} ({f.tier}) lie in one block alone: these balanced "
                "intervals are too narrow"
            )
    families = dict.fromkeys(f.family for f in v.figures)
    lines += [f"data of {family.name}: {family.data}" for family in families if family.data]
    lines += [f"trained by, {one.name}: {one.trained_by}" for one in families if one.trained_by]
    lines.append(f"judged by {v.judged_by}")
    everything = [f for f in v.figures if f.tier == "all"]
    tiers = [f for f in v.figures if f.family is base]
    classes = [["class", *(f.tier for f in tiers), *(f.family.name for f in everything)]]
    for name in everything[0].counts:
        counts = [str(f.counts.get(name, 0)) for f in tiers]
        classes.append([name, *counts, *(f"{100 * f.recall[name]:.0f}" for f in everything)])
    return "\n".join([*lines, "", "recall %", *aligned(classes, numbers=True)])


def csv_text(v: Verdict) -> str:
    """A row a family and tier, with a recall and a count for each class; shares in [0, 1].

    At its end how much more than the first family's its accuracies are, what the data are made of,
    and what trained and judged.
    """
    rows = []
    for f in v.figures:
        row: dict[str, Any] = {
            "run": f.family.name,
            "seeds": " ".join(map(str, f.family.seeds)),
            "tier": f.tier,
        }
        row |= {"objects": f.n, "blocks": f.blocks, "majority": f.majority}
        accuracies = {"accuracy": f.accuracy, "balanced": f.balanced}
        if f.more:
            accuracies |= {"accuracy_more": f.more[0], "balanced_more": f.more[1]}
        for name, one in accuracies.items():
            ends = {"": one.mean, "_sem": one.sem, "_low": one.low, "_high": one.high}
            row |= {f"{name}{key}": value for key, value in ends.items()}
        row |= {f"recall_{name}": f.recall.get(name) for name in v.classes}
        row |= {f"objects_{name}": f.counts.get(name, 0) for name in v.classes}
        made = {"data": f.family.data, "trained_by": f.family.trained_by}
        rows.append({**row, **made, "judged_by": v.judged_by})
    return pd.DataFrame(rows).to_csv(index=False, lineterminator="\n")


def json_text(v: Verdict) -> str:
    """Everything, paths as text."""
    values = dataclasses.asdict(v)
    return json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def _percent(one: Interval, sign: str = "") -> str:
    """Such as "64.0 ± 1.0 [58.1, 69.9]"."""
    mean, space, ends = one.percent(sign).partition(" ")
    sem = "" if one.sem is None else f" ± {100 * one.sem:.1f}"
    return f"{mean}{sem}{space}{ends}"
