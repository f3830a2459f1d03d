"""What was found, for people and for programs."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from qs3.report.judge.intervals import Share
from qs3.report.judge.judging import Verdict
from qs3.utils.plural import counted
from qs3.utils.text_table import aligned
from qs3.utils.text_table import csv_text as csv_of


def text(verdict: Verdict) -> str:
    """Tables: a row a family and tier; differences to the first family; a row a class."""
    v = verdict
    rows = [["run", "seeds", "tier", "objects", "blocks", "accuracy %", "balanced %", "majority %"]]
    for family in v.families:
        for f in family.figures:
            rows.append(
                [
                    family.name, ",".join(map(str, family.seeds)) or "?", f.tier, str(f.n),
                    str(f.blocks), _percent(f.accuracy), _percent(f.balanced),
                    f"{100 * f.majority:.1f}",
                ]
            )  # fmt: skip
    part = f", part {v.part}" if v.part else ""
    stray = "left out" if v.inliers_only else "kept"
    floor = "" if v.floor is None else f"; the floor lies at {v.floor:g} m"
    prior = f"; beside each run with prior={v.prior}, power {v.prior_power:g}" if v.prior else ""
    lines = [
        f"{v.data}{part}: real objects; stray points {stray}{floor}{prior}",
        *aligned(rows),
        "Mean ± SEM over seeds; in brackets the interval at 95 %, with blocks of frames as clusters"
        " and, of several runs, seeds.",
    ]
    alone = [f for f in v.families[0].figures if f.alone and f.blocks > 1]
    if said := "; ".join(f"{', '.join(f.alone)} ({f.tier})" for f in alone):
        lines.append(
            f"(!) seen in one block alone: {said}. How they vary from block to block is not known: "
            "these balanced intervals are too narrow"
        )
    lines += [f"data of {family.name}: {family.data}" for family in v.families if family.data]
    lines += [f"trained by, {f.name}: {f.trained_by}" for f in v.families if f.trained_by]
    lines.append(f"judged by {v.judged_by}")
    if v.differences:
        lines += ["", f"less {v.families[0].name}, paired object by object", *aligned(_less(v))]
        if any(d.seeds < 2 for d in v.differences):
            lines.append("(!) fewer than two common seeds: the interval is over blocks alone")
    if v.left_out:
        others = counted(v.left_out, "object of another class is", "objects of other classes are")
        lines.append(f"{others} left out.")
    return "\n".join([*lines, "", "recall %", *aligned(_classes(verdict), numbers=True)])


def _less(verdict: Verdict) -> list[list[str]]:
    """A row a difference."""
    rows = [["run", "tier", "accuracy", "balanced"]]
    for d in verdict.differences:
        name = d.name + " (!)" * (d.seeds < 2)
        rows.append([name, d.tier, _percent(d.accuracy, "+"), _percent(d.balanced, "+")])
    return rows


def _classes(verdict: Verdict) -> list[list[str]]:
    """A row a class: how many there are by tier, and each family's recall over all of them."""
    first = verdict.families[0].figures
    rows = [["class", *(f.tier for f in first), *(family.name for family in verdict.families)]]
    for name in verdict.classes:
        counts = [f.counts.get(name, 0) for f in first]
        if counts[0]:
            recalls = [family.figures[0].recall[name] for family in verdict.families]
            rows.append([name, *map(str, counts), *(f"{100 * r:.0f}" for r in recalls)])
    return rows


def csv_text(verdict: Verdict) -> str:
    """A row a family and tier, with a recall and a count for each class; shares in [0, 1].

    At its end how much more than the first family's its accuracies are (`less`: that family), what
    the data are made of, and what trained and judged.
    """
    names = verdict.classes
    none = [[None] * 9] * len(verdict.families[0].figures)  # of the first there is no difference
    more = none + [
        [d.base, *dataclasses.astuple(d.accuracy), *dataclasses.astuple(d.balanced)]
        for d in verdict.differences
    ]
    header = [
        "run", "seeds", "tier", "objects", "blocks", "accuracy", "accuracy_sem", "accuracy_low",
        "accuracy_high", "balanced", "balanced_sem", "balanced_low", "balanced_high", "majority",
        *(f"recall_{name}" for name in names), *(f"objects_{name}" for name in names),
        "less", "accuracy_more", "accuracy_more_sem", "accuracy_more_low", "accuracy_more_high",
        "balanced_more", "balanced_more_sem", "balanced_more_low", "balanced_more_high",
        "data", "trained_by", "judged_by",
    ]  # fmt: skip
    rows: list[list[Any]] = [header]
    figures = [(family, f) for family in verdict.families for f in family.figures]
    for (family, f), difference in zip(figures, more, strict=True):
        a, b = f.accuracy, f.balanced
        rows.append(
            [
                family.name, " ".join(map(str, family.seeds)), f.tier, f.n, f.blocks,
                a.mean, a.sem, a.low, a.high, b.mean, b.sem, b.low, b.high, f.majority,
                *(f.recall.get(name) for name in names),
                *(f.counts.get(name, 0) for name in names), *difference,
                family.data, family.trained_by, verdict.judged_by,
            ]
        )  # fmt: skip
    return csv_of(rows)


def json_text(verdict: Verdict) -> str:
    """Everything, paths as text."""
    values = dataclasses.asdict(verdict)
    return json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def _percent(share: Share, sign: str = "") -> str:
    sem = "" if share.sem is None else f" ± {100 * share.sem:.1f}"
    ends = ""
    if share.low is not None and share.high is not None:
        ends = f" [{100 * share.low:{sign}.1f}, {100 * share.high:{sign}.1f}]"
    return f"{100 * share.mean:{sign}.1f}{sem}{ends}"
