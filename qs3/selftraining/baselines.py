"""Baselines: what a selection is worth against a random one of the same size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from qs3.config.checks import check_choice, check_int
from qs3.errors import ConfigError
from qs3.selftraining.selectors import Selection, Selector, TeacherPredictions
from qs3.utils.seeding import derive


@dataclass(frozen=True)
class Random:
    """As many samples of each class as another selector keeps, drawn at random.

    A sample's chance is a number made from (seed, round, id): the same whatever the order and
    whatever else is in the table.

    Attributes:
        of: the other selector; its pseudo-labels are kept, its choice is not.
        seed: of the run.
        pool: drawn from the "confident" samples, above theta, or from "all" of the class.
    """

    of: Selector
    seed: int = 0
    pool: str = "confident"

    def __post_init__(self) -> None:
        if not hasattr(self.of, "select"):
            raise ConfigError("selftraining.selector.of must be a selector")
        check_int("selftraining.selector.seed", self.seed, 0)
        check_choice("selftraining.selector.pool", self.pool, ("confident", "all"))

    @property
    def own_thresholds(self) -> bool:
        """Whether the other selector has thresholds of its own."""
        return bool(getattr(self.of, "own_thresholds", False))

    @property
    def more_labels(self) -> str | None:
        """What would make the other selector keep more; None: a lower theta."""
        return _of_the_other(getattr(self.of, "more_labels", None))

    @property
    def instead_of_mu(self) -> str | None:
        """What the other selector has instead of its mu; None: it has none."""
        return _of_the_other(getattr(self.of, "instead_of_mu", None))

    @property
    def needs_features(self) -> bool:
        """Whether the other selector looks at features."""
        return bool(getattr(self.of, "needs_features", False))

    @property
    def begins_weightless(self) -> bool:
        """Whether nothing that the other selector selects in round 0 weighs anything."""
        return bool(getattr(self.of, "begins_weightless", False))

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; figures are those of the other selector."""
        given = self.of.select(teacher, theta, round_)
        if given.labels is not None:
            teacher = teacher.relabelled(given.labels)
        every = np.ones(len(teacher.ids), dtype=bool)
        allowed = teacher.confidence > theta if self.pool == "confident" else every
        lot = np.array([derive(self.seed, "random selection", round_, id_) for id_ in teacher.ids])
        drawn = np.argsort(lot, kind="stable")
        selected = np.zeros(len(teacher.ids), dtype=bool)
        for k in range(teacher.classes):
            of_class = drawn[allowed[drawn] & (teacher.predicted[drawn] == k)]
            selected[of_class[: given.kept[k]]] = True
        return replace(given, selected=selected)


def _of_the_other(advice: str | None) -> str | None:
    """The same with the keys where the other selector's settings are."""
    key = "selftraining.selector."
    return None if advice is None else advice.replace(key, f"{key}of.")
