"""What can be said about predictions whose labels nobody knows.

Three estimates of their accuracy, made from confidences alone, what else hints at trouble, and a
verdict of all. The three learn what a confidence means on labelled validation clouds of the source,
and carry it over to the target. That carries over only in part: clouds of another domain, or of no
known class, get high confidences too. `qs3.evaluation.trust` takes down for that:
docs/results/trust.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import nn

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.splits import Labelled, Unlabelled
from qs3.evaluation.confidences import agreement, estimates, rotation_agreement
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.evaluation.ood import limits, ood_reasons_of_all, relax_min_points
from qs3.evaluation.trust import Known, Seen, compared, judge
from qs3.evaluation.trust_file import read_calibration
from qs3.runs.metrics import AccuracyEstimates, Estimates

TURNS = 3
"""Rotations about the up axis besides none: by 90, 180 and 270 degrees."""

_LOOKED_AT = 300  # clouds of a domain, 3 ms each


def estimate_accuracy(
    net: nn.Module,
    target: Unlabelled,
    validation: Labelled,
    source: Clouds,
    *,
    owner: str,
    classes: Sequence[str],
    batch_size: int,
    device: Any = "cpu",
    teacher: nn.Module | None = None,
    unadapted: tuple[nn.Module, nn.Module | None] | None = None,
    upright: bool = True,
) -> tuple[AccuracyEstimates, Known | None]:
    """What `metrics.json` has under `quality`, and what the net knows of its labelled clouds.

    `qs3.evaluation.estimates_text` says it as text; the other is for the net's file.

    Looks at no label of the target. None where a figure does not exist (no teacher, no gravity), or
    is not finite because the net has diverged.

    Args:
        net: the reported one.
        target: the clouds that are judged.
        validation: labelled clouds that no warm-up was trained on.
        source: all labelled clouds.
        owner: of their labels, "source" or "target_train".
        classes: names in label order.
        teacher: the net before self-training; None if there was none.
        unadapted: net and teacher with the norms that they were trained with, for the labelled
            clouds of the source, where `net` and `teacher` have the target's (AdaBN).
        upright: z points up in the target's clouds.
    """
    points, labels = target.points, validation.labels.numpy()
    domain = "source" if owner == "source" else "target"
    as_trained, taught = unadapted if unadapted and owner == "source" else (net, teacher)
    known = predict(as_trained, validation.clouds.all(), batch_size, device, domain=domain)
    judged = predict(net, points, batch_size, device)
    counts = np.bincount(judged.argmax(axis=1), minlength=len(classes))
    about: dict[str, Any] = {
        "clouds": len(judged),
        "validated_on": f"{owner}_val",
        "validation_clouds": len(labels),
        "validation_accuracy": agreement(known, np.eye(len(classes))[labels]),
        "unlike_source": ood_fraction(target.clouds, source),
        "never_predicted": [name for name, n in zip(classes, counts, strict=True) if not n],
    }
    if not (np.isfinite(known).all() and np.isfinite(judged).all()):
        return AccuracyEstimates(**about), None
    about |= estimates(known, labels, judged)
    held_out = Known(known, labels, compared(source))
    measures = compared(target.clouds)
    about["trust"] = judge(held_out, Seen(judged, measures), read_calibration())
    if upright:
        turns = [2 * math.pi * i / (TURNS + 1) for i in range(1, TURNS + 1)]
        rotated = [predict_rotated(net, points, turn, batch_size, device) for turn in turns]
        about["rotation_agreement"] = rotation_agreement(judged, rotated)
    if teacher is not None:
        assert taught is not None
        theirs = predict(teacher, points, batch_size, device)
        about["teacher_agrees"] = agreement(judged, theirs)
        known = predict(taught, validation.clouds.all(), batch_size, device, domain=domain)
        if np.isfinite(known).all() and np.isfinite(theirs).all():
            accuracy = agreement(known, np.eye(len(classes))[labels])
            found = estimates(known, labels, theirs)
            # A student was taught to be sure of these clouds: its teacher was not.
            before = Known(known, labels, held_out.measures)
            about["trust"] = judge(before, Seen(theirs, measures), read_calibration())
            about["teacher"] = Estimates(validation_accuracy=accuracy, **found)
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
