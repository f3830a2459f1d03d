"""Every loss that a step can have, and a batch for it: shared by tests and benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from qs3.methods.base import Method
from qs3.methods.bounds import SourceOnly, Supervised
from qs3.methods.cpcm import Cpcm
from qs3.methods.dann import Dann
from qs3.methods.defrec import DefRec
from qs3.methods.gast import Gast
from qs3.methods.mlsp import Mlsp
from qs3.methods.pcm import Pcm
from qs3.methods.pointdan import PointDan
from qs3.methods.sd import Sd
from qs3.selftraining.pcfea import Pcfea
from qs3.selftraining.student import Student


@dataclass(frozen=True)
class Case:
    """One loss.

    Attributes:
        make: the method.
        passes: how often a batch passes through the net (PointDAN's through its generator). SD's
            two more are its teacher's, and have no way back.
        source: whether its batches have labelled source clouds.
        pseudo: pseudo-labels of its target clouds: "hard", "soft", or "" for none.
    """

    make: Callable[[], Method]
    passes: int
    source: bool = True
    pseudo: str = ""


def _styled(**settings: Any) -> Pcfea:
    """As it is once there is a pool."""
    method = Pcfea(**settings)
    method.styled = True
    return method


# A voxel of a toy cloud holds few points.
CASES = {
    "source_only": Case(SourceOnly, 1),
    "supervised": Case(Supervised, 1),
    "pcm": Case(Pcm, 1),
    "dann": Case(Dann, 2),
    "dann_apart": Case(lambda: Dann(domain_batches="apart"), 2),
    "pointdan": Case(PointDan, 2),
    "defrec": Case(lambda: DefRec(min_points=2), 2),
    "defrec_pcm": Case(lambda: DefRec(min_points=2, pcm=True), 2),
    "gast": Case(lambda: Gast(min_points=2), 5),
    "gast_pcm": Case(lambda: Gast(min_points=2, pcm=True), 5),
    "cpcm": Case(Cpcm, 3),
    "mlsp": Case(lambda: Mlsp(min_points=2), 2),
    "sd": Case(Sd, 2),
    "pcfea": Case(Pcfea, 1),  # until there is a pool
    "pcfea_styled": Case(_styled, 2),
    "student": Case(Student, 1, source=False, pseudo="hard"),
    "student_source": Case(lambda: Student(weight_step=0.005), 2, pseudo="hard"),
    "student_source_pcm": Case(lambda: Student(pcm=True), 2, pseudo="hard"),
    "student_lrent": Case(Student, 2, pseudo="soft"),
}


def batch_of(
    case: Case, method: Method, b: int, n: int, classes: int, device: str = "cpu"
) -> dict[str, Any]:
    """b clouds of n points in the unit ball, of each domain that the case asks for."""
    generator = torch.Generator().manual_seed(0)

    def clouds(count: int) -> torch.Tensor:
        points = torch.randn(count, b, n, 3, generator=generator)
        return (points / points.norm(dim=3).amax(2)[:, :, None, None]).to(device)

    points = clouds(2)
    labels = torch.arange(b, device=device) % classes
    batch: dict[str, Any] = {"index": 0, "epoch": 3, "progress": 0.5}
    if case.source:
        batch["source"] = {"points": points[0], f"y_{method.labels}": labels}
    if method.uses_target or case.pseudo:
        batch["target"] = {"points": points[1]}
    if case.pseudo:
        soft = nn.functional.one_hot(labels, classes).float() * 0.7 + 0.3 / classes
        batch["target"]["y_pseudo"] = soft if case.pseudo == "soft" else labels
    return batch


def total(
    method: Method, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
) -> torch.Tensor:
    """The loss that is minimised, as `Classifier.training_step` adds it up."""
    return torch.stack(list(method.loss(net, batch, generator).values())).sum()
