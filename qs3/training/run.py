"""One run: the one place where a config of `train.py` is judged, before torch is imported."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Interval
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import Field, Strict, ValidationError

from qs3.config.hydra import build, in_multirun, run_folder
from qs3.datamodules.phases import Phases, SelfTrainingConfig
from qs3.datasets.domain import Domain
from qs3.errors import ConfigError
from qs3.utils.settings import problems, settings

STUDENT = "student.pt"
"""Weights at the end of the last round."""

SCALES = {
    "qs3.models.simpleview.simpleview": ("unit_ball",),  # its cameras stand 1.4 from the middle
    **dict.fromkeys(  # they turn, deform or mask parts about the middle
        ("qs3.methods.gast.Gast", "qs3.methods.defrec.DefRec", "qs3.methods.mlsp.Mlsp"),
        ("unit_ball", "metres"),
    ),
}
"""Parts that cannot see every scale, by name, as their modules import torch."""

Switch = Annotated[bool, Strict()]  # Hydra reads `no` as a text


@settings
class Protocol:
    """The settings of config group `protocol`."""

    epochs: Annotated[int, Ge(1)]
    batch_size: Annotated[int, Ge(2)]  # batch norm needs two clouds
    optimizer: dict[str, Any]
    schedule: Literal["cosine", "plateau"]
    smoothing: Annotated[float, Interval(ge=0, lt=1)]
    regulariser: Annotated[float, Ge(0)]
    augment: dict[str, Any]
    steps: Annotated[int, Ge(1)] | None = None


@settings
class Rules:
    """Which weights are chosen: the settings `selection`."""

    teacher: Literal["source_val", "last", "given"]


@settings
class Judging:
    """How the reported net is evaluated: the settings `evaluation`."""

    norms: Literal["trained", "adabn", "alpha_bn", "tent"]
    prior: str | dict[str, float] | None
    prior_power: Annotated[float, Ge(0)]


@settings
class Settings:
    """What a config of `train.py` has; groups that are built are judged by their own classes."""

    data: dict[str, Any]
    model: dict[str, Any]
    method: dict[str, Any]
    protocol: Protocol
    selftraining: dict[str, Any]
    selection: Rules
    evaluation: Judging
    trainer: dict[str, Any]
    paths: dict[str, Any]
    report: dict[str, Any]
    experiment_name: Annotated[str, Field(pattern=r"^[^/]*[^/.][^/]*$")]  # a folder's name
    seed: Annotated[int, Ge(0)]
    num_classes: Annotated[int, Ge(2)]
    weights: str | None
    force: Switch
    objective: Literal["infomax"] | None  # does not look at the target's labels
    callbacks: dict[str, Any] | None = None
    logger: dict[str, Any] | None = None


@dataclass(frozen=True)
class Run:
    """One run, its settings checked and the light parts of its config built."""

    cfg: DictConfig
    folder: Path
    phases: Phases
    scheme: SelfTrainingConfig
    source: Domain
    target: Domain

    @property
    def seed(self) -> int:
        """The run's seed."""
        return int(self.cfg.seed)

    @property
    def is_upper_bound(self) -> bool:
        """Whether it learns from the target's labels, and the source has no part in it."""
        return self.cfg.method.get("_target_") == "qs3.methods.bounds.Supervised"


def run_of(cfg: DictConfig) -> Run:
    """The run that a config describes, whether it has begun or not.

    Raises:
        ConfigError: the config is not one of a run.
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    try:
        Settings(**plain)
    except ValidationError as error:
        raise ConfigError(problems(error)) from None
    scale = cfg.data.scale
    for group in ("method", "model"):
        if scale not in SCALES.get(name := cfg[group].get("_target_"), (scale,)):
            raise ConfigError(f"data.scale={scale}: {name} takes {' or '.join(SCALES[name])}")
    if cfg.selection.teacher == "given" and cfg.weights is None:
        raise ConfigError("selection.teacher=given: weights= names no classifier")
    devices = cfg.trainer.get("devices", 1)
    one = len(devices) == 1 if isinstance(devices, ListConfig) else str(devices) == "1"
    if not one and in_multirun():  # each further process would be started with the whole sweep
        raise ConfigError("trainer.devices: several processes (DDP) cannot be swept with -m")
    scheme: SelfTrainingConfig = build(cfg.selftraining)
    return Run(
        cfg=cfg,
        folder=run_folder(cfg),
        scheme=scheme,
        phases=Phases(
            cfg.protocol.epochs,
            scheme.rounds,
            scheme.epochs,
            cfg.protocol.steps,
            scheme.steps,
            unbroken=scheme.released,
        ),
        source=build(cfg.data.source),
        target=build(cfg.data.target),
    )
