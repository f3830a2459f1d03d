"""Gradient reversal: the identity forward, minus alpha times the gradient backward.

Ganin et al., "Domain-Adversarial Training of Neural Networks", JMLR 2016, section 3.3, eq. 16-18.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


class _Reverse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, alpha: float) -> Tensor:
        ctx.alpha = alpha
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return -ctx.alpha * grad, None


def reverse_gradient(x: Float[Tensor, "*shape"], alpha: float) -> Float[Tensor, "*shape"]:
    """R(x) = x with dR/dx = -alpha I; alpha >= 0."""
    return _Reverse.apply(x, alpha)


def dann_alpha(progress: float) -> float:
    """2 / (1 + exp(-10 p)) - 1: from 0 to 1 as p does (section 5.2.2); 0.5 at p = 0.11."""
    return 2.0 / (1.0 + math.exp(-10.0 * progress)) - 1.0


def sine_alpha(progress: float) -> float:
    """sin(p pi / 2): PointDAN's (its code: with p = (epoch + 1) / epochs), from 0 to 1."""
    return math.sin(progress * math.pi / 2)
