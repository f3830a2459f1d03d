"""CBST and CRST: a threshold of its own for each class.

Zou et al., "Unsupervised Domain Adaptation for Semantic Segmentation via Class-Balanced
Self-Training", ECCV 2018; Zou et al., "Confidence Regularized Self-Training", ICCV 2019. Both are
about pixels; the docstrings describe what is done here with clouds.
"""

import math
from decimal import Decimal
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Interval
from jaxtyping import Float, Int

from qs3.selftraining.selectors import Selection, TeacherPredictions
from qs3.utils.settings import settings


def class_thresholds(
    confidence: Float[np.ndarray, " n"],
    predicted: Int[np.ndarray, " n"],
    classes: int,
    portion: float,
) -> Float[np.ndarray, " k"]:
    """theta_k: the floor(portion n_k)-th largest confidence among the n_k predicted as k.

    1 if that rank is 0: an empty class, or one so rare that its portion is less than one sample.
    """
    thresholds = np.ones(classes)
    for k in range(classes):
        of_class = np.sort(confidence[predicted == k])[::-1]
        rank = math.floor(Decimal(repr(float(portion))) * len(of_class))  # 0.3 * 10 is 3 exactly
        if rank:
            thresholds[k] = of_class[rank - 1]
    return thresholds


@settings
class Cbst:
    r"""Class-balanced self-training: about the same portion of each predicted class.

    With thresholds theta_k as in `class_thresholds`, a sample's pseudo-label is
    argmax_k p_k / theta_k (the lowest k on ties), not argmax_k p_k: a class of which the teacher is
    never sure is not ruled out. It is kept if that quotient is >= 1 and its p_k > theta of the
    round (0 in the papers). Samples that tie with theta_k are kept as well, whatever their order.

    `labels="lrent"` is CRST's LRENT: pseudo-labels are soft, y_k proportional to
    (p_k / theta_k)^(1 / alpha), and a sample is kept if
    -sum y log p + alpha sum y log y < -sum y log theta, which is
    sum_k (p_k / theta_k)^(1 / alpha) > 1.
    CRST's MRKLD keeps what CBST keeps; it is a loss of the student (`selftraining.mrkld`).

    Attributes:
        portion: of each class in round 0, in (0, 1]; 0.2 in the released codes.
        step: added each round; 0.05.
        most: of the portion; 0.5.
        labels: "hard" or "lrent".
        alpha: weight of LRENT's entropy; 0.25 in the released code.
    """

    portion: Annotated[float, Interval(gt=0, le=1)] = 0.2
    step: Annotated[float, Ge(0)] = 0.05
    most: Annotated[float, Interval(gt=0, le=1)] = 0.5
    labels: Literal["hard", "lrent"] = "hard"
    alpha: Annotated[float, Gt(0)] = 0.25

    def portion_of(self, round_: int) -> float:
        """min(portion + round step, most), in decimal arithmetic."""
        grown = Decimal(repr(self.portion)) + round_ * Decimal(repr(self.step))
        return float(min(grown, Decimal(repr(self.most))))

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; the figure "confident" counts predictions above theta."""
        assert teacher.probabilities is not None
        classes, portion = teacher.classes, self.portion_of(round_)
        thresholds = class_thresholds(teacher.confidence, teacher.predicted, classes, portion)
        quotient = teacher.probabilities / thresholds  # [n, K]; thresholds > 0, as a largest p is
        labels = quotient.argmax(axis=1)
        soft = None
        keep = quotient.max(axis=1) >= 1
        if self.labels == "lrent":
            logs = np.log(np.maximum(quotient, np.finfo(float).tiny)) / self.alpha
            top = logs.max(axis=1, keepdims=True)
            powers = np.exp(logs - top)
            total = powers.sum(axis=1, keepdims=True)
            soft = powers / total
            # By the other terms alone, which vanish next to a largest of 1. A quotient of 1, as of
            # the sample that sets a threshold, is enough: no softmax says 0 of the other classes.
            others = np.sort(powers, axis=1)[:, :-1].sum(axis=1)
            keep |= top[:, 0] + np.log1p(others) > 0
        selected = keep & (teacher.relabelled(labels).confidence > theta)
        confident = teacher.predicted[teacher.confidence > theta]
        return Selection(
            selected=selected,
            theta=theta,
            mu=np.full(classes, portion),
            confident=np.bincount(confident, minlength=classes),
            kept=np.bincount(labels[selected], minlength=classes),
            labels=labels,
            soft=soft,
            thresholds=thresholds,
        )
