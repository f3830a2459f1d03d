"""Weights and clouds by formula, so that a net of others can be given the very same ones.

Unlike `set_weights`, `fill` goes by layers, not by parameters' names, so it can fill a net whose
modules are called otherwise, and it sets running statistics too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn


def layers(modules: Iterable[nn.Module]) -> tuple[list[nn.Module], list[nn.Module]]:
    """Linear maps (convolutions count) and batch norms, each in the order of the modules."""
    inside = [m for module in modules for m in module.modules()]
    linears = [m for m in inside if isinstance(m, nn.Linear | nn.Conv1d | nn.Conv2d)]
    norms = [m for m in inside if isinstance(m, nn.BatchNorm1d | nn.BatchNorm2d)]
    return linears, norms


@torch.no_grad()
def fill(modules: Iterable[nn.Module]) -> None:
    """Every weight a sine of its place: in its layer (i) and of the layer among its kind (j)."""
    linears, norms = layers(modules)
    for j, layer in enumerate(linears):
        fan_in = layer.weight[0].numel()
        layer.weight.copy_(_sine(layer.weight, 12.9898, j) / math.sqrt(fan_in / 3))
        if layer.bias is not None:
            layer.bias.copy_(0.1 * _sine(layer.bias, 4.1414, j))
    for j, norm in enumerate(norms):
        norm.weight.copy_(0.8 + 0.5 * _sine(norm.weight, 7.233, j))
        norm.bias.copy_(0.2 * _sine(norm.bias, 3.717, j))
        norm.running_mean.copy_(0.2 * _sine(norm.running_mean, 5.131, j))
        norm.running_var.copy_(1 + 0.5 * _sine(norm.running_var, 2.713, j))


def _sine(like: Tensor, frequency: float, j: int) -> Tensor:
    place = torch.arange(like.numel(), dtype=torch.float64).view(like.shape)
    return torch.sin(frequency * (place + 1) + 1.7 * j)


def clouds(b: int = 4, n: int = 96) -> Tensor:
    """[b, n, 3] float64 in [-1, 1], each cloud flat in another direction."""
    place = torch.arange(b * n * 3, dtype=torch.float64).view(b, n, 3)
    size = 0.2 + 0.8 * torch.sin(torch.arange(1.0, 3 * b + 1, dtype=torch.float64)).square()
    return size.view(b, 1, 3) * torch.sin(78.233 * (place + 1) + 0.001 * place.square())


def figures(logits: Tensor, points: Tensor) -> list[float]:
    """The first cloud's logits, and the norm of the cross entropy's gradient in the points."""
    loss = nn.functional.cross_entropy(logits, torch.arange(len(logits)) % logits.shape[1])
    (gradient,) = torch.autograd.grad(loss, points)
    return [*logits[0].tolist(), float(gradient.norm())]


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


def waves(b: int = 4, n: int = 600) -> Tensor:
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
