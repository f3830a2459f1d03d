"""Whether the answers of one call of `qs3 predict` can be trusted, and how that is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qs3.evaluation.estimates_text import of_whom, trust_in_words
from qs3.evaluation.trust import FEWEST, Seen, judge
from qs3.evaluation.trust_file import read_calibration
from qs3.inference.predictor import Predictor
from qs3.inference.scores import right
from qs3.inference.table import Row
from qs3.runs.metrics import Trust


def without_labels(verdict: str, rows: Sequence[Row], classes: Sequence[str]) -> str:
    """The verdict as it is said beside a count of right ones, if there are labels to count by."""
    judged = any(right(row, classes) is not None for row in rows)
    return f"Without a look at labels: {verdict}" if judged else verdict


def trust_of(rows: Sequence[Row], predictor: Predictor) -> tuple[Trust | None, str]:
    """The verdict, and it in words; None with the reason where nothing can be told.

    Labels that somebody gave play no part. Of answers with a prior it tells what is known of those
    without it, and of norms that follow a target what is known of the net before
    (`Predictor.asked`): its weights were fitted to such.
    """
    said = [row for row in rows if row.asked is not None]
    known = predictor.held_out
    if known is None:
        return None, (
            "how many are right cannot be told: the classifier's file does not say what it makes "
            "of held-out labelled clouds, as those of older versions, and folders of which not all "
            "was fetched; fetch all of it, or delete metrics.json in its run's folder and repeat "
            "the run's command, which trains nothing again"
        )
    if len(said) < FEWEST:
        return None, f"how many are right cannot be told of fewer than {FEWEST} clouds"
    asked = np.array([row.asked for row in said])
    if not np.isfinite(asked).all():
        return (
            None,
            "how many are right cannot be told: before its norms were the target's it diverged",
        )
    seen = Seen(asked, np.array([row.measures for row in said]))
    trust = judge(known, seen, read_calibration())
    assert trust is not None
    words = trust_in_words(trust) + of_whom(norms=predictor.before_target is not None)
    return trust, f"{words}; told of the answers without prior=" if predictor.prior else words
