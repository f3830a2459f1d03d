"""PCM on the source (Achituve et al., WACV 2021): classify clouds mixed from two, see `mixup`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from qs3.methods.base import Method
from qs3.methods.mixup import mix, pcm_loss


class Pcm(Method):
    """L = λ CE(net(x), y_a) + (1 - λ) CE(net(x), y_b), x mixed of two source clouds.

    The cross-entropy of unmixed clouds is not added, as in the authors' code. This is the
    warm-up of QS3.
    """

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Mixed cross-entropy, >= 0."""
        source = batch["source"]
        mixed, labels_a, labels_b, lam = mix(source["points"], source["y_source"], generator)
        return {"pcm": pcm_loss(net(mixed), labels_a, labels_b, lam, self.smoothing)}
