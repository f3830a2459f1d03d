"""Evaluation only, and a diagnostic: the last round's best epoch on the target's test set.

Nobody who deploys a model can choose so. The result says what the rules of `selection.student`
leave on the table; it is no result of a method, and `qs3.report` keeps it out of every table.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import nn

from qs3.datamodules.phases import Phases
from qs3.errors import ConfigError
from qs3.evaluation.metrics import Evaluation
from qs3.evaluation.selection_rules import LAST, ORACLE, ORACLE_IN_WORDS
from qs3.evaluation.validators import is_better
from qs3.selftraining.student_selection import Choice, candidate_path

log = logging.getLogger(__name__)


def check(evaluation: Evaluation) -> None:
    """Raise if there is nothing to choose by, before anything is trained.

    Raises:
        ConfigError: the target has no labelled test clouds.
    """
    if evaluation.y_target_eval is None:
        raise ConfigError(
            f"selection.student={ORACLE} chooses by the accuracy on the target's test clouds, but "
            f"data.target has no labelled test split; set selection.student={LAST}"
        )


def choose(
    folder: Path,
    phases: Phases,
    evaluation: Evaluation,
    trained: Callable[[Path], nn.Module],
    device: Any = "cpu",
) -> Choice:
    """The epoch of the last round with the highest accuracy on the target's test clouds.

    Args:
        folder: of a run whose training is over, with the weights of these epochs.
        phases: of the run.
        evaluation: has the labels.
        trained: the net with the weights in a file, as it would be reported.
        device: of the net.
    """
    scores: dict[int, float] = {}
    best = -1
    for epoch in range(*phases.span(phases.rounds)):
        net = trained(candidate_path(folder, epoch))
        scores[epoch] = evaluation.scores(net, device).accuracy or 0.0
        if is_better(ORACLE, scores[epoch], scores.get(best)):
            best = epoch
    log.warning("%s: epoch %d of %s", ORACLE_IN_WORDS, best, folder)
    return Choice(ORACLE, best, scores[best], scores, candidate_path(folder, best))
