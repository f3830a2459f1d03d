"""Saved runs judged on an archive of real objects that they were not trained on.

Accuracies with intervals: objects of one room are not independent, so blocks of frames in a row are
clusters, and seeds vary, too (`qs3.report.intervals`). Each cloud is thinned to the points that the
run was trained with. Nothing is trained, chosen or tuned by what comes out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int

from qs3.classes import known_as
from qs3.datasets.object_archive import JUDGE, TIERS, read_archive
from qs3.errors import ConfigError
from qs3.inference.model_file import FILE, find_result, pretrained_name
from qs3.inference.predictor import load
from qs3.report.intervals import Interval, difference, share
from qs3.runs.metrics import read_metrics
from qs3.utils.progress import progress_bar
from qs3.utils.text_table import aligned

BLOCK = 30
"""Frames in a row that make a cluster."""


@dataclass(frozen=True)
class Family:
    """Runs of one config that saw the same data (see `_families`): result files by seed, or -1."""

    name: str
    data: str = ""
    runs: dict[int, Path] = field(default_factory=dict)

    @property
    def seeds(self) -> list[int]:
        """In the order of `runs`, where they are known."""
        return [seed for seed in self.runs if seed >= 0]


@dataclass(frozen=True)
class Verdict:
    """What was judged, in words, and the figures of it.

    Attributes:
        figures: a row a family and tier ("all", "clean" or "hard"), shares in [0, 1]:
            run, seeds, tier, objects, blocks (of frames they come from);
            accuracy, balanced (over the classes that are there), accuracy_more and balanced_more
            (less the first family's, paired object by object), each with _sem, _low and _high;
            majority (what always naming the commonest class would reach);
            recall_CLASS, objects_CLASS;
            alone (classes whose objects are all of one block: with them the interval of the
            balanced accuracy is too narrow); data.
    """

    about: str
    classes: tuple[str, ...]
    figures: pd.DataFrame


def judge(
    runs: Sequence[str],
    data: Path,
    *,
    part: str = "",
    floor: float | None = None,
    device: str = "cpu",
) -> Verdict:
    """Judge saved runs on an archive's objects of the classes that every run knows.

    Args:
        runs: folders of runs, folders of such folders, or result files.
        data: the .npz; points that it marks as stray are left out.
        part: of its `dev`; none: "judge", where it has one, else all.
        floor: z of the floor in the archive, minus its camera's height, for nets that know heights.
        device: of the nets.
    """
    archive = read_archive(data)
    part = part or (JUDGE if JUDGE in archive.parts else "")
    chosen = archive.of_part(part) if part else list(range(len(archive)))
    families = _families(find_runs(runs))
    nets = {file: load(file, device=device) for one in families for file in one.runs.values()}
    for file, net in nets.items():
        if net.result.gravity != "z":
            raise ConfigError(f"{file} was trained on clouds in their camera's frame, not z up")
    first = next(iter(nets.values())).classes
    common = tuple(name for name in first if all(name in net.classes for net in nets.values()))
    names = [known_as(str(name), common) for name in archive.cls]
    kept = [i for i in chosen if names[i] is not None]
    if not kept:
        raise ConfigError(f"{data} has no objects of {', '.join(common)} in what was asked for")
    clouds = [archive.cloud(i) for i in kept]
    shown = [f"{data.name}[{i}]" for i in kept]
    predicted = {}
    with progress_bar("judging runs", total=len(nets)) as advance:
        for file, net in nets.items():
            place = [common.index(name) if name in common else -1 for name in net.classes]
            predicted[file] = np.array(place)[net(clouds, names=shown, floor=floor).argmax(axis=1)]
            advance()
    truth = np.array([common.index(str(names[i])) for i in kept])
    blocks, tiers = archive.frame[kept] // BLOCK, archive.tier[kept]
    subsets = {"all": np.ones(len(kept), dtype=bool)}
    subsets |= {tier: tiers == tier for tier in TIERS if (tiers == tier).any()}
    right = [np.stack([predicted[f] == truth for f in one.runs.values()]) for one in families]
    rows = []
    for family, mine in zip(families, right, strict=True):
        more = _less(family, mine, families[0], right[0])
        for tier, of in subsets.items():
            seeds = " ".join(map(str, family.seeds))
            row: dict[str, Any] = {"run": family.name, "seeds": seeds, "tier": tier}
            row |= _figures(mine[:, of], truth[of], blocks[of], common)
            if family is not families[0]:
                some = (more[:, of], truth[of], blocks[of])
                row |= _ends("accuracy_more", difference(*some))
                row |= _ends("balanced_more", difference(*some, balanced=True))
            rows.append({**row, "data": family.data})
    others = len(chosen) - len(kept)
    about = f"{data}{f', part {part}' * bool(part)}: real objects without stray points; "
    return Verdict(f"{about}{others} objects of other classes left out", common, pd.DataFrame(rows))


def find_runs(runs: Sequence[str]) -> list[Path]:
    """The result files that are meant, each once, in order; see `judge`."""
    found: dict[Path, None] = {}
    for words in runs:
        place = Path(words).expanduser()
        files = sorted(place.rglob(FILE)) if place.is_dir() else []
        found |= dict.fromkeys(map(find_result, files or [place]))
    return list(found)


def _families(files: Sequence[Path]) -> list[Family]:
    """The runs of each config that saw the same data."""
    found: dict[tuple[str, ...], Family] = {}
    for file in files:
        if m := read_metrics(file.parent):
            key = (m.experiment, m.hash, *m.seen.values())
            family, seed = Family(f"{m.experiment} {m.hash}", m.data_text), m.seed
        else:
            key, family, seed = (str(file),), Family(pretrained_name(file) or str(file)), -1
        family = found.setdefault(key, family)
        if seed in family.runs:
            raise ConfigError(f"{file} and {family.runs[seed]} are the same run twice")
        family.runs[seed] = file
    return [replace(one, runs=dict(sorted(one.runs.items()))) for one in found.values()]


def _less(family: Family, right: np.ndarray, base: Family, of_base: np.ndarray) -> np.ndarray:
    """[s, n] differences in being right: of common seeds; where there are none, of means."""
    if common := sorted({*family.seeds} & {*base.seeds}):
        places = [[one.seeds.index(seed) for seed in common] for one in (family, base)]
        return right[places[0]].astype(float) - of_base[places[1]]
    return right.mean(axis=0, keepdims=True) - of_base.mean(axis=0, keepdims=True)


def _figures(
    right: Bool[np.ndarray, "s n"],
    truth: Int[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> dict[str, Any]:
    """Columns of `Verdict.figures` for some objects."""
    counts = np.bincount(truth, minlength=len(names))
    there = [k for k, count in enumerate(counts) if count]
    return {
        "objects": len(truth),
        "blocks": len(np.unique(blocks)),
        **_ends("accuracy", share(right, truth, blocks)),
        **_ends("balanced", share(right, truth, blocks, balanced=True)),
        "majority": float(counts.max() / len(truth)),
        **{f"recall_{names[k]}": float(right[:, truth == k].mean()) for k in there},
        **{f"objects_{name}": int(count) for name, count in zip(names, counts, strict=True)},
        "alone": ", ".join(names[k] for k in there if len(np.unique(blocks[truth == k])) == 1),
    }


def _ends(name: str, one: Interval) -> dict[str, float]:
    """Columns of an interval; nan for what it has not."""
    ends = {"": one.mean, "_sem": one.sem, "_low": one.low, "_high": one.high}
    return {f"{name}{key}": np.nan if end is None else end for key, end in ends.items()}


def text(verdict: Verdict) -> str:
    """Tables: a row a family and tier, with differences to the first family; a row a class."""
    figures = verdict.figures
    first = figures.run.iloc[0]
    shown = [n for n in ("accuracy", "balanced", "accuracy_more", "balanced_more") if n in figures]
    more = {"accuracy_more": f"accuracy less {first}", "balanced_more": "balanced less its"}
    head = ["run", "seeds", "tier", "objects", "blocks", "majority %"]
    rows = [[*head, *(more.get(name, f"{name} %") for name in shown)]]
    for _, f in figures.iterrows():
        counts = [str(f.objects), str(f.blocks), f"{100 * f.majority:.1f}"]
        shares = [_percent(f, name) for name in shown]
        rows.append([f.run, f.seeds or "?", f.tier, *counts, *shares])
    lines = [
        verdict.about,
        *aligned(rows),
        "Mean ± SEM over seeds; in brackets 95 % intervals over blocks of frames and seeds",
    ]
    mine = figures[figures.run == first]
    for _, f in mine[(mine.alone != "") & (mine.blocks > 1)].iterrows():
        lines.append(f"(!) {f.alone} ({f.tier}) lie in one block alone: intervals are too narrow")
    every = figures[figures.tier == "all"]
    lines += [f"data of {f.run}: {f['data']}" for _, f in every.iterrows() if f["data"]]
    classes = [["class", *mine.tier, *every.run]]
    for name in (name for name in verdict.classes if every[f"objects_{name}"].iloc[0]):
        counts = [str(count) for count in mine[f"objects_{name}"]]
        classes.append([name, *counts, *(f"{100 * r:.0f}" for r in every[f"recall_{name}"])])
    return "\n".join([*lines, "", "recall %", *aligned(classes, numbers=True)])


def _percent(figures: pd.Series, name: str) -> str:
    """Such as "64.0 ± 1.0 [58.1, 69.9]"; "" if it is not known."""
    sign = "+" if name.endswith("_more") else ""
    mean, sem, low, high = (100 * figures[f"{name}{e}"] for e in ("", "_sem", "_low", "_high"))
    if np.isnan(mean):
        return ""
    ends = "" if np.isnan(low) else f" [{low:{sign}.1f}, {high:{sign}.1f}]"
    return f"{mean:{sign}.1f}{'' if np.isnan(sem) else f' ± {sem:.1f}'}{ends}"
