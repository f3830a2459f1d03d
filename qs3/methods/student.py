"""The student of a round of self-training: cross-entropy on pseudo-labelled target clouds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.methods.base import Method
from qs3.methods.mixup import mix, pcm_loss


class Student(Method):
    """L = CE(net(x_t), ŷ_t), plus the same on labelled source clouds if there are any.

    Args:
        pcm: mix the clouds first (QBST does not).
    """

    def __init__(self, pcm: bool = False) -> None:
        super().__init__()
        self.pcm = pcm

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms "pseudo" and, if the batch has source clouds, "source"; each >= 0."""
        owners = {"target": ("pseudo", "y_pseudo"), "source": ("source", "y_source")}
        return {
            name: self._term(net, batch[domain]["points"], batch[domain][labels], generator)
            for domain, (name, labels) in owners.items()
            if domain in batch
        }

    def _term(
        self, net: nn.Module, points: Tensor, labels: Tensor, generator: torch.Generator
    ) -> Tensor:
        if not self.pcm:
            return F.cross_entropy(net(points), labels)
        mixed, labels_a, labels_b, lam = mix(points, labels, generator)
        return pcm_loss(net(mixed), labels_a, labels_b, lam)
