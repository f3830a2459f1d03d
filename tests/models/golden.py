"""Weights and clouds by formula, for numbers recorded from the original networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def set_weights(model: nn.Module) -> None:
    """Parameter k (in the order of `named_parameters`) from sin(0.7 (k + 1) i + k)."""
    for k, (name, p) in enumerate(model.named_parameters()):
        i = torch.arange(p.numel(), dtype=torch.float64)
        wave = torch.sin(0.7 * (k + 1) * i + k).view(p.shape)
        if p.ndim > 1:
            wave *= (2 / p[0].numel()) ** 0.5
        elif "norm" in name and name.endswith("weight"):
            wave = 1 + wave / 4
        else:
            wave /= 10
        p.data.copy_(wave)


def clouds(b: int = 4, n: int = 600) -> Tensor:
    """[b, n, 3] in the unit ball; float32 numbers in float64."""
    i = torch.arange(b * n, dtype=torch.float64)[:, None]
    x = torch.sin(i * torch.tensor([1.37, 2.71, 4.13], dtype=torch.float64)).view(b, n, 3)
    x = x * (0.4 + 0.2 * torch.arange(b, dtype=torch.float64)[:, None, None])
    return (x / x.norm(dim=2).amax(1)[:, None, None]).float().double()


def gradient_norm(model: nn.Module) -> float:
    """Norm of the gradients of all parameters together."""
    return float(
        sum(p.grad.square().sum() for p in model.parameters() if p.grad is not None) ** 0.5
    )
