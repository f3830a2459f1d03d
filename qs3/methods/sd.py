"""SD, self-distillation: a student's features of a spoilt cloud follow a teacher's of the whole.

Cardace, Spezialetti, Zama Ramirez, Salti, Di Stefano, "Self-Distillation for Unsupervised 3D Domain
Adaptation", WACV 2023, its first step. The second, labels refined on a graph of the target's
clouds, is `selftraining=sd`.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from qs3.config.checks import check_choice, check_float
from qs3.geometry.neighbours import gather
from qs3.kernels.norms import use_domain
from qs3.methods.base import check_taught, class_loss, weight
from qs3.methods.mean_teacher import MeanTeacher

KEPT, LEAST, MOST = 0.7, 0.7, 1.5  # share of a cut cloud, and its size, of the released code


class Sd(MeanTeacher):
    r"""L = CE(net(x_s'), y_s) + w e^{-5 (1 - p)^2} H(softmax(g(x) / T_t), softmax(f(x') / T_s)).

    f: the backbone's vector of a cloud [B, D]; g: the same of the teacher, a net whose weights and
    statistics are running means of the student's; x: the batch's clouds of both domains; x': as
    they are spoilt for the student (`spoilt`); H(q, p) = -sum_d q_d log p_d, mean over the clouds;
    p: progress of the warm-up. The D features serve as logits; T_t < T_s sharpens what the student
    is to follow.

    Args:
        consistency_weight: w; 1 in the released code's logs, 0 trains on the source alone.
        momentum: m in [0, 1].
        teacher_temperature, student_temperature: T_t, T_s > 0.
        cut: whose spoilt clouds are cut, too: "source" as in the released code, which does so to
            those of CAD models, "both" or "none".

    Of the released code's spoiling the elastic distortion is left out. Turn and jitter are those of
    `protocol.augment`, before: teacher and student see the same ones.
    """

    uses_target: ClassVar[bool] = True

    def __init__(
        self,
        consistency_weight: float = 1.0,
        momentum: float = 0.999,
        teacher_temperature: float = 0.1,
        student_temperature: float = 0.5,
        cut: str = "source",
    ) -> None:
        super().__init__(momentum)
        self.consistency_weight = weight("consistency_weight", consistency_weight)
        for key, value in (("teacher", teacher_temperature), ("student", student_temperature)):
            check_float(f"method.{key}_temperature", value, "> 0")
        self.teacher_temperature, self.student_temperature = (
            teacher_temperature,
            student_temperature,
        )
        self.cut = check_choice("method.cut", cut, ("source", "both", "none"))

    def prepare(self, net: Any) -> None:
        """The teacher."""
        if self.consistency_weight:
            check_taught(net, "method=sd", "choose method=pcfea, or a model that is trained")
        super().prepare(net)

    def loss(
        self, net: Any, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "ce" and "consistency", each >= 0."""
        if batch.get("step_begins", True):
            self.follow(net)
        source = batch["source"]
        found = {}
        for domain in ("source", "target"):
            points = batch[domain]["points"]
            kept = KEPT if self.cut in (domain, "both") else 1.0
            with use_domain(net, domain), use_domain(self.teacher, domain):
                student = net.features(spoilt(points, kept, generator)).global_  # [B, D]
                teacher = self.teacher.features(points).global_
            found[domain] = student, teacher
        ce = class_loss(net.head(found["source"][0]), source["y_source"], self.smoothing)
        student, teacher = (torch.cat(both) for both in zip(*found.values(), strict=True))
        sharp = (teacher / self.teacher_temperature).softmax(dim=1)
        consistency = F.cross_entropy(student / self.student_temperature, sharp)
        ramp = self.consistency_weight * math.exp(-5 * (1 - batch["progress"]) ** 2)
        return {"ce": ce, "consistency": ramp * consistency}


def spoilt(
    points: Float[Tensor, "b n 3"], kept: float, generator: torch.Generator
) -> Float[Tensor, "b n 3"]:
    """Each cloud at another size, U(0.7, 1.5), and without what lies behind a plane.

    Of any direction, so that the share `kept` of the points stays; they stay where they are, and
    some drawn at random are repeated in the places of the others.
    """
    b, n, _ = points.shape
    own = generator.device
    size = torch.rand(b, 1, 1, generator=generator, device=own).to(points)
    points = points * (LEAST + (MOST - LEAST) * size)
    left = max(1, round(kept * n))
    if left == n:
        return points
    normal = torch.randn(b, 3, 1, generator=generator, device=own).to(points)
    again = torch.randint(left, (b, n - left), generator=generator, device=own).to(points.device)
    front = (points @ normal)[..., 0].argsort(dim=1, descending=True, stable=True)[:, :left]
    return gather(points, torch.cat([front, front.take_along_dim(again, dim=1)], dim=1))
