"""SD, self-distillation: a student's features of a spoilt cloud follow a teacher's of the whole.

Cardace, Spezialetti, Zama Ramirez, Salti, Di Stefano, "Self-Distillation for Unsupervised 3D Domain
Adaptation", WACV 2023, its first step. The second, labels refined on a graph of the target's
clouds, is `selftraining=sd`. The teacher's weights are running means of the student's: Tarvainen,
Valpola, "Mean teachers are better role models", NeurIPS 2017.
"""

import copy
import math
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Gt
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.errors import ConfigError
from qs3.geometry.neighbours import gather
from qs3.kernels.norms import use_domain
from qs3.methods.base import Batch, Method, Terms, Weight, class_loss
from qs3.utils.settings import Share, checked


@torch.no_grad()
def move_towards(mean: nn.Module, net: nn.Module, part: Tensor) -> None:
    """A running mean of weights and statistics takes `part` in [0, 1] of the net's.

    Raises:
        ConfigError: weights are in half precision, in which a mean stands still: it rounds away
            what a step adds, and a count beyond 256.
    """
    theirs = net.state_dict()
    if any(one.dtype in (torch.float16, torch.bfloat16) for one in theirs.values()):
        raise ConfigError("trainer.precision: a running mean stands still in half precision")
    for name, value in mean.state_dict().items():
        if value.is_floating_point():
            value.lerp_(theirs[name], part.to(value))
        else:
            value.copy_(theirs[name])  # counts of batch norm


KEPT, LEAST, MOST = 0.7, 0.7, 1.5  # share of a cut cloud, and its size, of the released code


class Sd(Method):
    r"""L = CE(net(x_s'), y_s) + w e^{-5 (1 - p)^2} H(softmax(g(x) / T_t), softmax(f(x') / T_s)).

    f: the backbone's vector of a cloud [B, D]; g: the same of the teacher in eval mode, which no
    gradient reaches; x: the batch's clouds of both domains; x': as they are spoilt for the student
    (`spoilt`), of which the source's alone are cut, as in the released code; H(q, p) =
    -sum_d q_d log p_d, mean over the clouds; p: progress of the warm-up. The D features serve as
    logits; T_t < T_s sharpens what the student is to follow.

    After step t = 0, 1, ... the teacher takes the part max(1 / (t + 1), 1 - m) of the student's
    weights and statistics: a plain mean at first.

    Args:
        consistency_weight: w; 1 in the released code's logs, 0 trains on the source alone.
        momentum: m.
        teacher_temperature, student_temperature: T_t, T_s.

    Of the released code's spoiling the elastic distortion is left out. Turn and jitter are those of
    `protocol.augment`, before: teacher and student see the same ones.
    """

    uses_target: ClassVar[bool] = True
    steps: Tensor

    @checked
    def __init__(
        self,
        consistency_weight: Weight = 1.0,
        momentum: Share = 0.999,
        teacher_temperature: Annotated[float, Gt(0)] = 0.1,
        student_temperature: Annotated[float, Gt(0)] = 0.5,
    ) -> None:
        super().__init__()
        self.consistency_weight, self.momentum = consistency_weight, momentum
        self.teacher_temperature = teacher_temperature
        self.student_temperature = student_temperature
        self.teacher: Any = None
        self.register_buffer("steps", torch.zeros((), dtype=torch.float64))

    def prepare(self, net: Any) -> None:
        """The teacher, which is the student before its first step."""
        self.teacher = copy.deepcopy(net).requires_grad_(False)

    @torch.no_grad()
    def follow(self, net: nn.Module) -> None:
        """One step of the running means; the first takes the student as it is.

        Called before a step it does what it would do after the one before.
        """
        self.teacher.eval()  # the trainer puts all modules into training mode, now and then
        self.steps += 1
        move_towards(self.teacher, net, (1 / self.steps).clamp_min(1 - self.momentum))

    def loss(self, net: Any, batch: Batch, generator: torch.Generator) -> Terms:
        """Terms "ce" and "consistency", each >= 0."""
        if batch.get("step_begins", True):
            self.follow(net)
        source = batch["source"]
        found = {}
        for domain in ("source", "target"):
            points = batch[domain]["points"]
            kept = KEPT if domain == "source" else 1.0
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
