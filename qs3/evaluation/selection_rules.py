"""Which epoch of the last round is reported: the rules of `selection.student`, by name. Light.

    last        the last epoch. Nothing is computed.
    pseudo_val  accuracy on pseudo-labelled target clouds that were held out of the last round, as
                in QS3's released code (there in each round; see `validators.hold_out`).
    entropy     three scores that need no labels at all, of the predictions for the target's
    infomax     training clouds (see `validators`).
    snd

The earliest epoch wins a tie.
"""

from __future__ import annotations

import re
from typing import Any

from qs3.errors import ConfigError

LAST = "last"
PSEUDO_VAL = "pseudo_val"
STUDENT_RULES = (LAST, PSEUDO_VAL, "entropy", "infomax", "snd")
OBJECTIVES = ("entropy", "infomax", "snd")
"""What a search may ask for: none looks at a label of the target, all judge on the same clouds."""


def chosen_in_words(chosen: str) -> str:
    """`selection.teacher` or `.student` of metrics.json for people, who count epochs from 1.

    "source_val, epoch 7" is "source_val, epoch 8", as the progress of a run counts.
    """
    return re.sub(r"(?<=, epoch )\d+", lambda epoch: str(int(epoch[0]) + 1), chosen)


def check_objective(objective: Any) -> None:
    """Refuse what a search must not or cannot look at; None: there is no search.

    Raises:
        ConfigError: it is not a label-free score, or one that differs between trials for no merit.
    """
    if objective is None:
        return
    if objective == PSEUDO_VAL:
        raise ConfigError(
            f"objective={PSEUDO_VAL} is refused: each trial would be judged on clouds and "
            "pseudo-labels that it selected itself, and a higher theta selects easier ones; set "
            f"objective={'|'.join(OBJECTIVES)} (selection.student={PSEUDO_VAL} may stay)"
        )
    if objective not in OBJECTIVES:
        raise ConfigError(
            f"objective={objective} is refused: a search chooses hyper-parameters, and on a new "
            "target there are no labels to choose them by (accuracy looks at those of the test "
            f"set); set objective={'|'.join(OBJECTIVES)}"
        )
