"""Baselines: what a selection is worth against a random one of the same size."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge

from qs3.selftraining.selectors import Selection, TeacherPredictions
from qs3.utils.seeding import derive
from qs3.utils.settings import settings


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
