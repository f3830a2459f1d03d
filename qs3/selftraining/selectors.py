"""Which pseudo-labels to trust: pure functions on a table of predictions (numpy only).

A selector sees one row a target sample: its id and the probabilities that the teacher gives it. It
never sees a label. The result does not depend on the order of the rows, nor on what names say
(`ranked`). Here: QBST, SPST and the random control; CBST and CRST in `cbst`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from annotated_types import Ge, Interval
from jaxtyping import Bool, Float, Int

from qs3.errors import ConfigError, SelectionError
from qs3.utils.seeding import derive
from qs3.utils.settings import settings


@dataclass(frozen=True, eq=False)
class TeacherPredictions:
    """A teacher's predictions for the target samples.

    Attributes:
        ids: of the samples, all different.
        confidence: [n] probability of the predicted class, float64.
        predicted: [n] that class.
        classes: K.
        probabilities: [n, K] of all classes; only some selectors look at them.
        features: [n, D] of a selector that says `needs_features`.
    """

    ids: Sequence[str]
    confidence: Float[np.ndarray, " n"]
    predicted: Int[np.ndarray, " n"]
    classes: int
    probabilities: Float[np.ndarray, "n k"] | None = None
    features: Float[np.ndarray, "n d"] | None = None

    @classmethod
    def of(
        cls,
        probabilities: Float[np.ndarray, "n k"],
        ids: Sequence[str],
        features: Float[np.ndarray, "n d"] | None = None,
    ) -> TeacherPredictions:
        """Those of the most probable classes; the lowest on ties."""
        predicted = probabilities.argmax(axis=1)
        confidence = probabilities.max(axis=1).astype(np.float64)
        return cls(ids, confidence, predicted, probabilities.shape[1], probabilities, features)

    def relabelled(self, labels: Int[np.ndarray, " n"]) -> TeacherPredictions:
        """The same with other classes named, and the probabilities of those."""
        assert self.probabilities is not None
        chosen = np.take_along_axis(self.probabilities, labels[:, None], axis=1)[:, 0]
        return replace(self, predicted=labels, confidence=chosen.astype(np.float64))

    @property
    def doubt(self) -> Float[np.ndarray, " n"] | None:
        """See `doubts`; None where only confidences are known."""
        known = self.probabilities
        return None if known is None else doubts(known, self.predicted)


@dataclass(frozen=True, eq=False)
class Selection:
    """What a round will be trained on, and the figures that led to it (per class: [K]).

    Attributes:
        selected: [n] whether each sample is kept.
        theta: the threshold used.
        mu: [K] fraction of the confident samples of each class to keep.
        confident: [K] samples above the threshold, by predicted class.
        kept: [K] samples kept, by pseudo-label.
        labels: [n] pseudo-labels; None where they are the predicted classes.
        soft: [n, K] pseudo-labels as probabilities; None trains on `labels`.
        thresholds: [K] of each class, of selectors that have such.
    """

    selected: Bool[np.ndarray, " n"]
    theta: float
    mu: Float[np.ndarray, " k"]
    confident: Int[np.ndarray, " k"]
    kept: Int[np.ndarray, " k"]
    labels: Int[np.ndarray, " n"] | None = None
    soft: Float[np.ndarray, "n k"] | None = None
    thresholds: Float[np.ndarray, " k"] | None = None


class Selector(Protocol):
    """Chooses among predictions; an object built from config group `selftraining`."""

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """Choose the samples to train on; may choose none (the caller decides what that means).

        Args:
            teacher: its predictions.
            theta: the probability of every chosen pseudo-label exceeds it.
            round_: counted from 0.
        """
        ...


@settings
class Qbst:
    r"""Quasi-balanced self-training (QS3, section 3.2): the rarer a class, the more of it is kept.

    With A = {i : p_i > theta}, n = |A| and n_k = |{i in A : k_i = k}|, class k keeps the
    ceil(mu_k n_k) most confident of its samples in A, where mu_k = 1 - L_k / n.

    Attributes:
        mu: "balanced" as above; "one" keeps every confident sample (a control).
        order: "descending" keeps the most confident, as the paper says; "ascending" the least
            confident, as the released code does.
        counts: L_k in mu_k = 1 - L_k / n. "all" counts all target samples predicted as k, as the
            paper's words read (mu_k is 0 where that exceeds n); "confident" counts L_k = n_k in A,
            as the released code does.
        floor: share of the samples predicted as each class, the most confident ones, that is kept
            whatever theta and mu say, so that no class dies out (ours; the paper has none).
    """

    mu: Literal["balanced", "one"] = "balanced"
    order: Literal["descending", "ascending"] = "descending"
    counts: Literal["confident", "all"] = "all"
    floor: Annotated[float, Interval(ge=0, le=1)] = 0.0

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; looks at the predicted classes and how sure of them it is."""
        confidence, predicted = teacher.confidence, teacher.predicted
        classes = teacher.classes
        above = confidence > theta
        n_k = np.bincount(predicted[above], minlength=classes)
        n = int(n_k.sum())
        counted = np.bincount(predicted, minlength=classes) if self.counts == "all" else n_k
        rest = np.full(classes, n) if self.mu == "one" else np.maximum(n - counted, 0)  # mu_k n
        quota = -(-(rest * n_k) // max(n, 1))  # ceil(mu_k n_k), in whole numbers: no rounding error

        order = ranked(confidence, teacher.ids, teacher.doubt, ascending=self.order == "ascending")
        selected = np.zeros(len(confidence), dtype=bool)
        for k in range(classes):
            of_class = order[above[order] & (predicted[order] == k)]
            selected[of_class[: quota[k]]] = True
        if self.floor:
            everyone = (predicted, self.floor, teacher.ids, teacher.doubt)
            selected |= most_confident(confidence, *everyone, least=1)
        return Selection(
            selected=selected,
            theta=theta,
            mu=rest / max(n, 1),
            confident=n_k,
            kept=np.bincount(predicted[selected], minlength=classes),
        )


@settings
class Spst:
    """Self-paced self-training: every sample with p_i > theta (GAST, section 3.3; no other rule).

    The pace is theta's, which grows by `selftraining.epsilon` a round. Chooses what
    `Qbst(mu="one")` chooses.
    """

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; looks at the predicted classes alone."""
        selected = teacher.confidence > theta
        kept = np.bincount(teacher.predicted[selected], minlength=teacher.classes)
        return Selection(selected, theta, mu=np.ones(len(kept)), confident=kept, kept=kept)


@settings
class Random:
    """As many samples of each class as another selector keeps, drawn at random.

    A sample's chance is a number made from (seed, round, id): the same whatever the order and
    whatever else is in the table.

    Attributes:
        of: the other selector; its pseudo-labels are kept, its choice is not.
        seed: of the run.
        pool: drawn from the "confident" samples, above theta, or from "all" of the class.
    """

    of: Any
    seed: Annotated[int, Ge(0)] = 0
    pool: Literal["confident", "all"] = "confident"

    @property
    def needs_features(self) -> bool:
        """Whether the other selector looks at features."""
        return bool(getattr(self.of, "needs_features", False))

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; figures are those of the other selector."""
        given: Selection = self.of.select(teacher, theta, round_)
        if given.labels is not None:
            teacher = teacher.relabelled(given.labels)
        every = np.ones(len(teacher.ids), dtype=bool)
        allowed = teacher.confidence > theta if self.pool == "confident" else every
        key = [derive(self.seed, "random selection", round_, id_) for id_ in teacher.ids]
        drawn = np.argsort(np.array(key), kind="stable")
        selected = np.zeros(len(teacher.ids), dtype=bool)
        for k in range(teacher.classes):
            of_class = drawn[allowed[drawn] & (teacher.predicted[drawn] == k)]
            selected[of_class[: given.kept[k]]] = True
        return replace(given, selected=selected)


def doubts(
    probabilities: Float[np.ndarray, "n k"], labels: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """1 - p of each row's label, as the sum of the others: with digits where p is rounded to 1."""
    others = probabilities.copy()
    np.put_along_axis(others, labels[:, None], 0.0, axis=1)
    return others.sum(axis=1)


def ranked(
    confidence: Float[np.ndarray, " n"],
    ids: Sequence[str],
    doubt: Float[np.ndarray, " n"] | None = None,
    *,
    ascending: bool = False,
) -> Int[np.ndarray, " n"]:
    """Positions of the most confident samples first; of the least confident if `ascending`.

    A net that has trained for long says exactly 1 of many: among equal ones the less doubtful are
    the more confident. What ties still goes by a number made from the id, neither by the id nor by
    place: names begin with classes ("chair/train/0001") and datasets are sorted by them, so these
    would be labels.
    """
    lot = np.array([derive(0, "tie", id_) for id_ in ids])
    keys = (np.zeros(len(lot)) if doubt is None else doubt, -confidence)
    return np.lexsort((lot, *(-key if ascending else key for key in keys)))


def most_confident(
    confidence: Float[np.ndarray, " n"],
    labels: Int[np.ndarray, " n"],
    share: float,
    ids: Sequence[str],
    doubt: Float[np.ndarray, " n"] | None = None,
    least: int = 0,
) -> Bool[np.ndarray, " n"]:
    """The max(least, round(share n_k)) first of the n_k samples of each label k, by `ranked`."""
    order = ranked(confidence, ids, doubt)
    chosen = np.zeros(len(labels), dtype=bool)
    for k in np.unique(labels):
        of_class = order[labels[order] == k]
        chosen[of_class[: max(least, round(share * len(of_class)))]] = True
    return chosen


def chosen_by(
    selector: Selector, teacher: TeacherPredictions, theta: float, round_: int
) -> Selection:
    """What a selector, perhaps a user's, chooses; `kept` counted anew by its mask and its labels.

    Raises:
        ConfigError: `selected` is not a mask: positions would be taken for other samples.
    """
    found = selector.select(teacher, theta, round_)
    if found.selected.dtype != np.bool_ or found.selected.shape != (len(teacher.ids),):
        name = type(selector).__name__
        raise ConfigError(f"{name}.select: `selected` must be True or False for each sample")
    labels = teacher.predicted if found.labels is None else found.labels
    kept = np.bincount(labels[found.selected], minlength=teacher.classes)
    return replace(found, kept=kept)


def check_selection(
    selection: Selection,
    class_names: Sequence[str],
    round_: int,
    processes: int = 1,
) -> list[str]:
    """Names of the classes without a pseudo-label, after checking that training is possible.

    Raises:
        SelectionError: one of the `processes` has fewer than two samples (batch normalisation needs
            two).
    """
    missing = [name for name, n in zip(class_names, selection.kept, strict=True) if n == 0]
    total = int(selection.kept.sum())
    if total <= processes:
        raise SelectionError(
            f"round {round_}: {total} pseudo-labels above theta={selection.theta:g}, none for "
            f"{', '.join(missing) or 'none of the classes'}; lower the threshold, or train the "
            "teacher for longer"
        )
    return missing
