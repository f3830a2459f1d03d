"""The card of an exported classifier: what it is, what it was found to be worth, what it lacks."""

from __future__ import annotations

import math
import re

from qs3.evaluation.selection_rules import chosen_in_words
from qs3.inference.judgement import Judgement, percent
from qs3.inference.model_file import PACKAGES, Result, own_module
from qs3.runs.metrics import RunMetrics
from qs3.utils.plural import counted
from qs3.utils.version import VERSION

_Z = 1.959964  # of a normal distribution: 95 % lie within so many standard deviations


def card(
    result: Result,
    metrics: RunMetrics | None,
    command: str = "",
    judgement: Judgement | None = None,
) -> str:
    """The card as Markdown, with YAML at its top.

    Args:
        result: the classifier.
        metrics: of its run; None if only its file is at hand: then no figures are stated.
        command: that trained it; "" likewise.
        judgement: what it was found to be worth on real objects; None if nobody looked.
    """
    net = result.model["_target_"].rpartition(".")[2]
    title = f"{net}, {metrics.source} to {metrics.target}" if metrics else f"{net}"
    floor = ", floor=0.0" if result.scale == "above_floor" else ""
    own = own_module(result)
    packages = f', packages=["{PACKAGES[0]}", "{own}"]' if own else ""
    told = f" packages={own}" if own else ""
    lines = [
        "---",
        "library_name: qs3",
        "pipeline_tag: other",
        "tags: [point-cloud, 3d, classification, depth-sensor, domain-adaptation]",
        "---",
        "",
        f"# {title}",
        "",
        f"Classifies point clouds of single objects into {len(result.classes)} classes: "
        f"{', '.join(map(_text, result.classes))}.",
        "",
        "```python",
        "import qs3",
        "",
        f'predictor = qs3.load("this folder"{packages})',
        f"probabilities = predictor([cloud]{floor})  # [n, 3], any n, {_frame(result)}",
        "```",
        "",
        f"Or: `qs3 predict ckpt=FOLDER input=SCANS{floor.replace(',', '')}{told}`.",
        *([f"The net is defined in {own}, which is not part of qs3."] if own else []),
        "",
        "## Input",
        "",
        f"- {_SCALE[result.scale]}",
        f"- {_GRAVITY[result.gravity]}",
        f"- {result.points} points, the farthest from each other, of a cloud of "
        f"{result.stored_points}; others are thinned or filled up.",
        "",
        "## Training",
        "",
        *(_training(metrics) if metrics else ["Not recorded in the file that this was made from."]),
        *(["", "```", command, "```"] if command else []),
        "",
        "## Accuracy",
        "",
        _accuracy(metrics),
        "",
        *([*_judged(judgement), ""] if judgement else []),
        _LIMITS,
        "",
        "- Every object gets one of these classes, also one of no class, often with high "
        "confidence.",
        "- Confidence is not accuracy on clouds of another kind; `qs3 predict` marks clouds out of "
        "the ranges of training.",
        "- Which way is up is not guessed.",
        "- Terms of use are those of the data above; state them when you publish this folder.",
        "",
        f"Written by qs3 {VERSION}.",
        "",
    ]
    return "\n".join(lines)


def carried(text: str, judgement: Judgement | None) -> str:
    """The card of an exported classifier for its copy; a new judgement takes the place of its own.

    What its run knew stands on it and nowhere else.
    """
    if judgement is None:
        return text
    before, limits, after = text.partition(_LIMITS)
    before = before.partition(_REAL)[0].rstrip("\n")
    return "\n".join([before, "", *_judged(judgement), "", limits + after])


_REAL = "\nOn real objects of "
_LIMITS = "## Limits"
_SCALE = {
    "unit_ball": "Any unit and size: clouds are put into the unit ball.",
    "metres": "Metres: the net knows sizes.",
    "above_floor": "Metres: the net knows sizes and heights above the floor, which is given.",
}
_GRAVITY = {"z": "z up.", "none": "In the frame of the depth camera: x right, y down, z forward."}


def _frame(result: Result) -> str:
    up = {"z": "z up", "none": "z forward"}[result.gravity]
    unit = {"unit_ball": "", "metres": ", metres", "above_floor": ", metres; floor: its z"}
    return up + unit[result.scale]


def _training(metrics: RunMetrics) -> list[str]:
    m = metrics
    return [
        f"- Source, with labels: {m.source} ({m.made_of.source})",
        f"- Target, without: {m.target_text} ({m.made_of.target})",
        f"- Method: {m.method}; self-training: {m.selftraining}; selected by "
        f"{chosen_in_words(m.selection.teacher)}",
        f"- Settings: {m.hash} (SHA-256 {m.config_sha256}), seed {m.seed}",
        f"- Data (SHA-256): source {m.data.source}, target {m.data.target}",
        f"- Versions: {', '.join(f'{name} {version}' for name, version in m.versions.items())}",
    ]


def _accuracy(metrics: RunMetrics | None) -> str:
    if metrics is None:
        return "Not recorded in the file that this was made from."
    final = metrics.final
    if final.accuracy is None:
        return "Not known: the target has no labels."
    low, high = wilson(round(final.accuracy * final.n), final.n)
    return (
        f"On {counted(final.n, 'test cloud')} of {metrics.target_text}: {final.accuracy:.1%} (95 % "
        f"interval {low:.1%} to {high:.1%} if clouds are independent), balanced "
        f"{final.balanced_accuracy:.1%}; always the commonest class {final.majority_rate:.1%}."
        f"{_told(metrics.evaluation.prior)}"
    )


def _told(prior: str) -> str:
    """What the figures above were told, which the files beside the card do not hold."""
    if not prior:
        return ""
    return (
        f" That is with `evaluation.prior`: {_text(prior)}. Without `prior=` of `qs3.load` or "
        "`qs3 predict`, this classifier is told nothing of the kind."
    )


def _judged(judgement: Judgement) -> list[str]:
    """On real objects: a table by tier, and recalls."""
    part = f", part {_text(judgement.part)}" if judgement.part else ""
    every = judgement.tiers[0]
    recalls = (
        f"{_text(name)} {percent(value)} (of {every.counts.get(name, 0)})"
        for name, value in every.recall.items()
    )
    return [
        f"{_REAL.strip()} {_file(judgement.data)}{part}:",
        "",
        "| objects | number | accuracy, 95 % interval | balanced | commonest class % |",
        "|---|---|---|---|---|",
        *(
            f"| {_text(one.tier)} | {one.n} | {one.accuracy} | {one.balanced} | "
            f"{percent(one.majority)} |"
            for one in judgement.tiers
        ),
        "",
        f"Recall %: {', '.join(recalls)}.",
    ]


def wilson(right: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson, "Probable inference", JASA 22, 1927)."""
    share, spread = right / of, _Z * _Z / of
    middle = (share + spread / 2) / (1 + spread)
    half = _Z / (1 + spread) * math.sqrt(share * (1 - share) / of + spread / (4 * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _text(name: str) -> str:
    """A name as it stands: Markdown and HTML mean nothing in it."""
    return "".join(c if c.isalnum() or c in " -" else f"&#{ord(c)};" for c in name)


def _file(name: str) -> str:
    """A file's name, as code where it is a usual one."""
    return f"`{name}`" if re.fullmatch(r"[\w.-]+", name) else _text(name)
