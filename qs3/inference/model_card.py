"""The card of an exported classifier: what it is, how accurate it was, what it lacks."""

from __future__ import annotations

import math

from qs3.evaluation.validators import chosen_in_words
from qs3.inference.model_file import PACKAGES, Result
from qs3.runs.metrics import RunMetrics
from qs3.utils.version import VERSION

_Z = 1.959964  # of a normal distribution: 95 % lie within so many standard deviations
_SCALE = {
    "unit_ball": "Any unit and size: clouds are put into the unit ball.",
    "metres": "Metres: the net knows sizes.",
    "above_floor": "Metres: the net knows sizes and heights above the floor, which is given.",
}
_GRAVITY = {"z": "z up.", "none": "In the frame of the depth camera: x right, y down, z forward."}
_CARD = """---
library_name: qs3
pipeline_tag: other
tags: [point-cloud, 3d, classification, depth-sensor, domain-adaptation]
---

# {title}

Classifies point clouds of single objects into {count} classes: {classes}.

```python
import qs3

predictor = qs3.load("this folder"{packages})
probabilities = predictor([cloud]{floor})  # [n, 3], any n
```

Or: `qs3 predict ckpt=FOLDER input=SCANS`.{own}

## Input

- {scale}
- {gravity}
- {points} points, the farthest from each other, of a cloud of {stored}; others are thinned or filled up.

## Training

{training}

## Accuracy

{accuracy}

## Limits

- Every object gets one of these classes, also one of no class, often with high confidence.
- Confidence is not accuracy on clouds of another kind; `qs3 predict` marks clouds out of the ranges of training.
- Which way is up is not guessed.
- Terms of use are those of the data above; state them when you publish this folder.

Written by qs3 {version}.
"""  # noqa: E501
_UNKNOWN = "Not recorded in the file that this was made from."


def card(result: Result, metrics: RunMetrics | None, command: str = "") -> str:
    """The card as Markdown, with YAML at its top.

    Args:
        result: the classifier.
        metrics: of its run; None if only its file is at hand: then there are no figures.
        command: that trained it; "" likewise.
    """
    net, own = result.model["_target_"].rpartition(".")[2], result.own_module
    training = _training(metrics) if metrics else _UNKNOWN
    return _CARD.format(
        title=f"{net}, {metrics.source} to {metrics.target}" if metrics else net,
        count=len(result.classes),
        classes=", ".join(map(_text, result.classes)),
        packages=f', packages=["{PACKAGES[0]}", "{own}"]' if own else "",
        floor=", floor=0.0" if result.scale == "above_floor" else "",
        own=f" The net is defined in {own}, which is not part of qs3 (packages=)." if own else "",
        scale=_SCALE[result.scale],
        gravity=_GRAVITY[result.gravity],
        points=result.points,
        stored=result.stored_points,
        training=training + (f"\n\n```\n{command}\n```" if command else ""),
        accuracy=_accuracy(metrics) if metrics else _UNKNOWN,
        version=VERSION,
    )


def _training(m: RunMetrics) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in m.versions.items())
    return f"""- Source, with labels: {m.source} ({m.made_of.source})
- Target, without: {m.target_text} ({m.made_of.target})
- Method: {m.method}; self-training: {m.selftraining}; selected by \
{chosen_in_words(m.selection.teacher)}
- Settings: {m.hash} (SHA-256 {m.config_sha256}), seed {m.seed}
- Data (SHA-256): source {m.data.source}, target {m.data.target}
- Versions: {versions}"""


def _accuracy(metrics: RunMetrics) -> str:
    final, prior = metrics.final, metrics.evaluation.prior
    if final.accuracy is None or final.balanced_accuracy is None or final.majority_rate is None:
        return "Not known: the target has no labels."
    low, high = wilson(round(final.accuracy * final.n), final.n)
    told = f" With `evaluation.prior`, which `qs3.load` lacks: {_text(prior)}." if prior else ""
    return (
        f"On {final.n} test clouds of {metrics.target_text}: {final.accuracy:.1%} (95 % interval "
        f"{low:.1%} to {high:.1%} if clouds are independent), balanced "
        f"{final.balanced_accuracy:.1%}; always the commonest class {final.majority_rate:.1%}."
        f"{told}"
    )


def wilson(right: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson, "Probable inference", JASA 22, 1927)."""
    share, spread = right / of, _Z * _Z / of
    middle = (share + spread / 2) / (1 + spread)
    half = _Z / (1 + spread) * math.sqrt(share * (1 - share) / of + spread / (4 * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _text(name: str) -> str:
    """A name as it is: Markdown and HTML mean nothing in it."""
    return "".join(c if c.isalnum() or c in " -" else f"&#{ord(c)};" for c in name)
