"""One run, its settings checked: what every stage of the train command is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from qs3.data.domain import Domain
from qs3.datamodules.phases import Phases, SelfTrainingConfig

STUDENT = "student.pt"
"""Weights at the end of the last round."""


@dataclass(frozen=True)
class Run:
    """One run, its settings checked and the light parts of its config built."""

    cfg: DictConfig
    folder: Path
    seed: int
    phases: Phases
    scheme: SelfTrainingConfig
    source: Domain
    target: Domain
