"""A teacher whose weights are running means of the student's.

Tarvainen, Valpola, "Mean teachers are better role models", NeurIPS 2017.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from qs3.config.checks import check_float
from qs3.errors import ConfigError
from qs3.methods.base import Method, feature_dims


class MeanTeacher(Method):
    """A method with such a teacher; it is in eval mode, and no gradient reaches it.

    After step t = 0, 1, ... the mean takes the part max(1 / (t + 1), 1 - m) of the student's
    weights and statistics: a plain mean at first.

    Args:
        momentum: m in [0, 1].
    """

    steps: Tensor

    def __init__(self, momentum: float) -> None:
        super().__init__()
        self.momentum = check_float("method.momentum", momentum, "[0, 1]")
        self.teacher: Any = None
        self.register_buffer("steps", torch.zeros((), dtype=torch.float64))

    def prepare(self, net: nn.Module) -> None:
        """The teacher, which is the student before its first step."""
        feature_dims(net)  # it has features at all
        self.teacher = copy.deepcopy(net).requires_grad_(False)

    @torch.no_grad()
    def follow(self, net: nn.Module) -> None:
        """One step of the running means; the first takes the student as it is.

        Called before a step it does what it would do after the one before.
        """
        assert self.teacher is not None, "prepare() comes first"
        self.teacher.eval()  # the trainer puts all modules into training mode, now and then
        self.steps += 1
        move_towards(self.teacher, net, (1 / self.steps).clamp_min(1 - self.momentum))


@torch.no_grad()
def move_towards(mean: nn.Module, net: nn.Module, part: Tensor) -> None:
    """A running mean of weights and statistics takes `part` in [0, 1] of the net's.

    Raises:
        ConfigError: weights are in half precision, in which a mean stands still: it rounds away
            what a step adds, and a count beyond 256.
    """
    theirs = net.state_dict()
    if any(one.dtype in (torch.float16, torch.bfloat16) for one in theirs.values()):
        raise ConfigError(
            "trainer.precision: a running mean of a net's weights, as this method has, stands "
            "still in half precision, which rounds its small steps away; set "
            "trainer.precision=bf16-mixed, whose weights are float32, or 32-true"
        )
    for name, value in mean.state_dict().items():
        if value.is_floating_point():
            value.lerp_(theirs[name], part.to(value))
        else:
            value.copy_(theirs[name])  # counts of batch norm
