"""One run, its settings checked: what every stage of the train command is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from qs3.config import hashing
from qs3.config.checks import check_int
from qs3.config.hydra import build
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datasets.domain import Domain

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

    @property
    def is_upper_bound(self) -> bool:
        """Whether it learns from the target's labels, and the source has no part in it."""
        return self.cfg.method.get("_target_") == _SUPERVISED


_SUPERVISED = "qs3.methods.bounds.Supervised"  # its name only: its module imports torch


def run_of(cfg: DictConfig) -> Run:
    """The run that a config describes, whether it has begun or not.

    Raises:
        ConfigError: seed, self-training or a domain is not one.
    """
    scheme: SelfTrainingConfig = build(cfg.selftraining)
    return Run(
        cfg=cfg,
        seed=check_int("seed", cfg.seed, 0),
        folder=hashing.run_folder(cfg),
        scheme=scheme,
        phases=Phases(
            cfg.protocol.epochs,
            scheme.rounds,
            scheme.epochs,
            cfg.protocol.steps,
            scheme.steps,
        ),
        source=build(cfg.data.source),
        target=build(cfg.data.target),
    )
