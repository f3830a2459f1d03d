"""Source only: cross-entropy on labelled source clouds; the target is never looked at."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from qs3.methods.base import Method, class_loss


class SourceOnly(Method):
    """L = CE(net(x_s), y_s): the lower bound of every table."""

    def loss(
        self, net: nn.Module, batch: dict[str, Any], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Cross-entropy, >= 0."""
        source = batch["source"]
        return {"ce": class_loss(net(source["points"]), source["y_source"], self.smoothing)}
