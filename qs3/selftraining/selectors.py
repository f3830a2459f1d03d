"""Which pseudo-labels to trust: pure functions on a table of predictions (numpy only).

A selector sees one row a target sample: its id and the probabilities that the teacher gives it. It
never sees a label. The result does not depend on the order of the rows, nor on what names say
(`ranked`). Here: QBST and SPST; CBST and CRST in `cbst`, baselines in `baselines`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.config.checks import check_choice, check_of_use
from qs3.datamodules.phases import LOWER_THETA, RAISE_SHARE
from qs3.errors import ConfigError, SelectionError
from qs3.utils.plural import counted
from qs3.utils.seeding import derive

_KEEP_ALL = "set selftraining.selector.mu=one"


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


@dataclass(frozen=True)
class Qbst:
    r"""Quasi-balanced self-training (QS3, section 3.2): the rarer a class, the more of it is kept.

    With A = {i : p_i > theta}, n = |A| and n_k = |{i in A : k_i = k}|, class k keeps the
    ceil(mu_k n_k) most confident of its samples in A, where mu_k = 1 - n_k / n.

    Attributes:
        mu: "balanced" as above; "one" keeps every confident sample (a control).
        order: "descending" keeps the most confident, as the paper says; "ascending" the least
            confident, as the released code does.
        counts: L_k in mu_k = 1 - L_k / n. "confident" counts L_k = n_k in A, as the released code
            does; "all" counts all target samples predicted as k, as the paper's words read. That
            can exceed n, so mu_k is clamped at 0 there.
    """

    instead_of_mu: ClassVar[str] = _KEEP_ALL

    mu: str = "balanced"
    order: str = "descending"
    counts: str = "confident"

    def __post_init__(self) -> None:
        check_choice("selftraining.selector.mu", self.mu, ("balanced", "one"))
        check_choice("selftraining.selector.order", self.order, ("descending", "ascending"))
        check_choice("selftraining.selector.counts", self.counts, ("confident", "all"))
        some = self.mu == "balanced"  # else all that are confident are kept
        for key, usual in (("order", "descending"), ("counts", "confident")):
            key, value = f"selftraining.selector.{key}", getattr(self, key)
            check_of_use(key, value, usual, some, "set selftraining.selector.mu=balanced")

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
        return Selection(
            selected=selected,
            theta=theta,
            mu=rest / max(n, 1),
            confident=n_k,
            kept=np.bincount(predicted[selected], minlength=classes),
        )


@dataclass(frozen=True)
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
        ConfigError: it is no `Selection`, or does not say of each sample whether it is kept: places
            in place of a mask would be taken for other samples. Or a label is none of a class, or
            a figure not one of each class.
    """
    found = selector.select(teacher, theta, round_)
    mask, n = getattr(found, "selected", None), len(teacher.ids)
    if isinstance(found, Selection) and isinstance(mask, np.ndarray):
        if mask.dtype == np.bool_ and mask.shape == (n,):
            _check_figures(type(selector).__name__, found, n, teacher.classes)
            labels = teacher.predicted if found.labels is None else found.labels
            return replace(found, kept=np.bincount(labels[mask], minlength=teacher.classes))
        what = f"{mask.dtype} {list(mask.shape)}"
    else:
        what = f"of type {type(found if mask is None else mask).__name__}"
    raise ConfigError(
        f"{type(selector).__name__}.select must return a Selection (qs3.selftraining.selectors) "
        f"whose `selected` is an array of True or False for each of {counted(n, 'sample')}; it is "
        f"{what}"
    )


def _check_figures(name: str, found: Selection, n: int, classes: int) -> None:
    """Refuse labels that are no classes, and figures of another shape or kind than is recorded."""
    for key, shape, kinds in (
        ("mu", (classes,), "iuf"),
        ("confident", (classes,), "iu"),
        ("labels", (n,), "iu"),
        ("soft", (n, classes), "f"),
        ("thresholds", (classes,), "iuf"),
    ):
        value = getattr(found, key)
        if value is None and key not in ("mu", "confident"):
            continue
        value = np.asarray(value)
        if value.shape != shape or value.dtype.kind not in kinds:
            of = "numbers" if "f" in kinds else "whole numbers"
            raise ConfigError(
                f"{name}.select: `{key}` must be an array {list(shape)} of {of}, it is "
                f"{value.dtype} {list(value.shape)}"
            )
        if key == "labels" and not ((value >= 0) & (value < classes)).all():
            raise ConfigError(f"{name}.select: `labels` must lie in 0 to {classes - 1}")


def keep_all(selection: Selection, labels: Int[np.ndarray, " n"]) -> Selection:
    """The same with every sample selected."""
    kept = np.bincount(labels, minlength=len(selection.kept))
    return replace(selection, selected=np.ones(len(labels), dtype=bool), kept=kept)


def check_teacher(teacher: TeacherPredictions, round_: int, trainable: bool = True) -> None:
    """Refuse a teacher whose probabilities are not numbers, before a selector is asked.

    Args:
        teacher: the predictions that round `round_` would choose from.
        round_: for the message; in round 0 the warm-up's net made them, later the round before's.
        trainable: whether the warm-up's net was trained in this run.

    Raises:
        SelectionError: a probability is NaN: the net has diverged.
    """
    lost = int(np.isnan(teacher.confidence).sum())
    if not lost:
        return
    net = f"round {round_ - 1}'s student" if round_ else "the warm-up's net"
    way = "lower protocol.optimizer.lr"
    if not round_ and not trainable:
        net, way = "the net of weights=", "choose another one"
    raise SelectionError(
        f"{net} has diverged: its probabilities of {lost} of {len(teacher.ids)} target clouds are "
        f"not numbers, so that round {round_} has no pseudo-labels; {way}"
    )


def check_selection(
    selection: Selection,
    class_names: Sequence[str],
    round_: int,
    missing_class: str,
    more: Sequence[str] = (LOWER_THETA,),
    longer: str | None = "protocol.epochs",
    instead_of_mu: str | None = _KEEP_ALL,
    processes: int = 1,
) -> list[str]:
    """Names of the classes without a pseudo-label, after checking that training is possible.

    Args:
        selection: of the round.
        class_names: in label order.
        round_: for messages.
        missing_class: "warn" or "error".
        more: what would select more, for messages; see `SelfTrainingConfig.more_labels`. Of a
            threshold that all samples exceed nothing is said.
        longer: the setting by which the teacher is trained for longer; None: it was given.
        instead_of_mu: what selects more where only one class is confident; None where the selector
            has no mu for it; see `SelfTrainingConfig.instead_of_mu`.
        processes: that share the samples out, one of them to two where they come out uneven.

    Raises:
        SelectionError: a process has fewer than two samples (batch normalisation needs two), or
            a class is missing and `missing_class` is "error".
    """
    missing = [name for name, n in zip(class_names, selection.kept, strict=True) if n == 0]
    total = int(selection.kept.sum())
    table = ", ".join(
        f"{name} {kept}/{confident}"
        for name, kept, confident in zip(
            class_names, selection.kept, selection.confident, strict=True
        )
    )
    facts = f"round {round_} with theta={selection.theta}: selected/confident by class: {table}"
    better = [] if longer is None else [f"train the teacher longer ({longer})"]
    # Where all are above the threshold, a lower one selects no more.
    every = int(selection.confident.sum()) >= len(selection.selected)
    ways = [way for way in more if not (every and way in (LOWER_THETA, RAISE_SHARE))] + better
    if total <= processes:
        own_mu = selection.mu[selection.confident > 0]
        why = ""
        if instead_of_mu and len(own_mu) == 1 and own_mu[0] == 0:
            why = "all confident samples are of one class, so its mu is 0; "
            ways.append(instead_of_mu)
        if processes > 1:
            why += f"each of {processes} processes needs two; "
            ways.append("give fewer trainer.devices")
        raise SelectionError(
            f"only {counted(total, 'pseudo-label')} selected in {facts}; {why}{', or '.join(ways)}"
        )
    if missing and missing_class == "error":
        why = ""
        if every and not selection.confident[selection.kept == 0].any():
            why, ways = "the teacher takes no cloud for one; ", better
        ways = [*ways, "accept it with selftraining.missing_class=warn"]
        raise SelectionError(
            f"no pseudo-label for {', '.join(missing)} in {facts}; {why}{', or '.join(ways)}"
        )
    return missing
