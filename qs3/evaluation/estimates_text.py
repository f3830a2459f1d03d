"""`quality` of `metrics.json` as text; `qs3.evaluation.accuracy_estimates` computes it."""

from __future__ import annotations

from collections.abc import Mapping

from qs3.evaluation.trust_file import SHIFTS
from qs3.runs.metrics import AccuracyEstimates, Estimates, Trust
from qs3.utils.plural import counted

DO_NOT_TRUST = "do not trust this"

MEANINGS: Mapping[str, str] = {
    "validation_accuracy": "accuracy on held-out labelled clouds. On others it will be lower",
    "mean_confidence": "mean largest probability, as the net gives it. Nets are too sure of "
    "themselves, on clouds of another domain most of all",
    "calibrated": "expected accuracy if confidences meant on your clouds what they mean on "
    "held-out labelled clouds (AC). Too high as a rule, because your clouds differ from these",
    "thresholded": "share of your clouds above the certainty that as many held-out labelled "
    "clouds miss as are wrong (ATC). Too high as a rule; can be off either way",
    "difference": "accuracy on held-out labelled clouds, less what is lost in confidence (DoC). "
    "Too high as a rule",
    "rotation_agreement": "share of clouds with the same class after rotations about the up axis, "
    "which change no class. What changes is unreliable; what stays can be wrong all the same",
    "teacher_agrees": "share of clouds on which the net before self-training says the same. "
    "The student learnt from it, so both can be wrong together",
    "unlike_source": "share of clouds outside the range of the labelled ones in spacing, flatness "
    "or height, so unlike all that came with a label. Few say nothing: a new object can look usual",
    "never_predicted": "classes that no cloud got. Either there are none of them, or they are "
    "all taken for something else",
}
"""What each figure tells, and what it does not."""


def in_words(quality: AccuracyEstimates) -> str:
    """The estimates in short, for the end of a headline; "" without any."""
    if quality.trust is not None:
        return trust_in_words(quality.trust) + _of_whom(quality)
    if quality.calibrated is None:
        return ""
    before = f" (before self-training {_range(quality.teacher)})" if quality.teacher else ""
    return (
        f"accuracy estimated from confidences alone {_range(quality)}{before}, which is too high "
        "as a rule, on real clouds by far"
    )


def trust_in_words(trust: Trust) -> str:
    """How many answers are expected to be right, how far off that can be, and what speaks against.

    Such as "about 62% expected to be right, give or take 9 points" or "do not trust this: ...".
    """
    evidence = "; ".join(reasons(trust))
    why = f": {evidence}" if evidence else ""
    if trust.trusted:
        return (
            f"about {trust.expected:.0%} expected to be right, give or take "
            f"{counted(round(100 * trust.error), 'point')} ({trust.held_out:.0%} on held-out "
            f"labelled clouds{f', less{why}' if evidence else ''})"
        )
    return f"{DO_NOT_TRUST}: about {trust.expected:.0%} expected to be right{why}"


def _of_whom(quality: AccuracyEstimates) -> str:
    return of_whom(rounds=quality.teacher is not None, norms=quality.trust_without_norms)


def of_whom(rounds: bool = False, norms: bool = False) -> str:
    """A net that was adapted is surer than it is right, so it was asked as it was before.

    `rounds`, `norms`: what adapted it. "" if nothing did.
    """
    found = ["before self-training"] if rounds else []
    found += ["with the norms it was trained with"] if norms else []
    return f" (of the net {' and '.join(found)})" if found else ""


def reasons(trust: Trust, most: int = 3) -> list[str]:
    """What took most from the estimate, in words with its figure; at most `most`.

    A shift that took less than a tenth of the largest is not named.
    """
    taken = sorted(((lost, name) for name, lost in trust.lost.items() if lost > 0), reverse=True)
    found = [
        f"{SHIFTS[name]} ({trust.shifts[name]:.2f})"
        for lost, name in taken[:most]
        if lost > taken[0][0] / 10
    ]
    if not trust.trusted and trust.held_out < 0.5:
        found.insert(0, f"even of held-out labelled clouds {trust.held_out:.0%} are right")
    return found


def _range(quality: Estimates) -> str:
    figures = (quality.calibrated, quality.thresholded, quality.difference)
    found = [value for value in figures if value is not None]
    low, high = f"{min(found):.0%}", f"{max(found):.0%}"
    return low if low == high else f"{low} to {high}"


def table(quality: AccuracyEstimates) -> list[tuple[str, str, str]]:
    """Name, value and meaning of each figure that there is, for people."""
    rows = []
    if quality.trust is not None:
        words = trust_in_words(quality.trust) + _of_whom(quality)
        rows.append(("expected accuracy", f"{quality.trust.expected:.1%}", f"{words}."))
    for key, meaning in MEANINGS.items():
        value = getattr(quality, key)
        if value is None:
            continue
        shown = f"{value:.1%}" if isinstance(value, float) else ", ".join(value) or "none"
        before = getattr(quality.teacher, key, None)
        if before is not None:
            shown += f" (before self-training {before:.1%})"
        rows.append((key.replace("_", " "), shown, f"{meaning}."))
    return rows
