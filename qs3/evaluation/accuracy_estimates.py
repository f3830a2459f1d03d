"""What can be said about predictions whose labels nobody knows.

Three estimates of their accuracy, made from confidences alone, what else hints at trouble, and a
verdict of all. The three learn what a confidence means on labelled validation clouds of the source,
and carry it over to the target. That carries over only in part: clouds of another domain, or of no
known class, get high confidences too. `qs3.evaluation.trust` takes down for that:
docs/results/tried.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from qs3.datamodules.clouds import Clouds
from qs3.evaluation.confidences import agreement, estimates, rotation_agreement
from qs3.evaluation.ood import limits, ood_reasons_of_all, relax_min_points
from qs3.evaluation.trust import Known, Seen, compared, judge
from qs3.evaluation.trust_file import read_calibration
from qs3.runs.metrics import AccuracyEstimates, Estimates

TURNS = 3
"""Rotations about the up axis besides none: by 90, 180 and 270 degrees."""

_LOOKED_AT = 300  # clouds of a domain, 3 ms each


@dataclass(frozen=True, eq=False)
class Said:
    """Class probabilities by one net.

    Attributes:
        validation: of labelled clouds that no warm-up was trained on.
        target: of the clouds that are judged.
    """

    validation: Float[np.ndarray, "v c"]
    target: Float[np.ndarray, "n c"]

    @property
    def finite(self) -> bool:
        """False of a net that has diverged."""
        return bool(np.isfinite(self.validation).all() and np.isfinite(self.target).all())


def estimate_accuracy(
    said: Said,
    labels: Int[np.ndarray, " v"],
    clouds: Clouds,
    source: Clouds,
    *,
    owner: str,
    classes: Sequence[str],
    teacher: Said | None = None,
    asked: Said | None = None,
    turned: Callable[[float], Float[np.ndarray, "n c"]] | None = None,
) -> tuple[AccuracyEstimates, Known | None]:
    """What `metrics.json` has under `quality`, and what `said` knows of the labelled clouds.

    `qs3.evaluation.estimates_text` says it as text; the other is for the net's file.

    Looks at no label of the target. None where a figure does not exist (no teacher, no gravity), or
    is not finite because the net has diverged.

    Args:
        said: by the reported net.
        labels: of the validation clouds.
        clouds: those that are judged.
        source: all labelled clouds.
        owner: of the labels, "source" or "target_train".
        classes: names in label order.
        teacher: by the net before self-training; None if there was none.
        asked: by the net as it was before the target's clouds changed it, by whose answers the
            verdict is (`trust`); None: nothing did.
        turned: by the reported net of the judged clouds after a rotation about z by an angle in
            radians; None if z does not point up in them.
    """
    counts = np.bincount(said.target.argmax(axis=1), minlength=len(classes))
    about: dict[str, Any] = {
        "clouds": len(said.target),
        "validated_on": f"{owner}_val",
        "validation_clouds": len(labels),
        "validation_accuracy": agreement(said.validation, np.eye(len(classes))[labels]),
        "unlike_source": ood_fraction(clouds, source),
        "never_predicted": [name for name, n in zip(classes, counts, strict=True) if not n],
    }
    if not said.finite:
        return AccuracyEstimates(**about), None
    about |= estimates(said.validation, labels, said.target)
    held_out = Known(said.validation, labels, compared(source))
    measures = compared(clouds)
    about["trust"] = judge(held_out, Seen(said.target, measures), read_calibration())
    if turned is not None:
        turns = [2 * math.pi * i / (TURNS + 1) for i in range(1, TURNS + 1)]
        about["rotation_agreement"] = rotation_agreement(said.target, [*map(turned, turns)])
    if teacher is not None:
        about["teacher_agrees"] = agreement(said.target, teacher.target)
        if teacher.finite:
            accuracy = agreement(teacher.validation, np.eye(len(classes))[labels])
            found = estimates(teacher.validation, labels, teacher.target)
            about["teacher"] = Estimates(validation_accuracy=accuracy, **found)
    if asked is not None:
        # A student was taught to be sure of these clouds, and the target's statistics make a net
        # surer of them: as it was before, it was not.
        before = Known(asked.validation, labels, held_out.measures)
        seen = Seen(asked.target, measures)
        about["trust"] = judge(before, seen, read_calibration()) if asked.finite else None
    return AccuracyEstimates(**about), held_out


def ood_fraction(clouds: Clouds, source: Clouds) -> float:
    """The share of clouds outside the usual range of the source's.

    At most 300 of each are looked at, evenly spaced.
    """
    found = ood_reasons_of_all(clouds, source_ranges(source, _LOOKED_AT), most=_LOOKED_AT)
    return sum(map(bool, found)) / len(found)


def source_ranges(source: Clouds, most: int = 1000) -> dict[str, list[float]]:
    """Range of each measure in at most `most` clouds; of points no more than the net sees."""
    seen = source.stored.shape[1] if source.order is None else source.order.shape[2]
    return relax_min_points(limits(source, most=most), seen)
